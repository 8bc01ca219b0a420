"""The record of a folder that holds a run of each shot of a clip, and the run in it that a command works on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta
from typing_extensions import NotRequired, TypedDict

from flowsplat.common.errors import InputError
from flowsplat.common.files import hash_files, read_json, write_json
from flowsplat.common.files.json_file import Count, Text
from flowsplat.common.run_paths import RunPaths
from flowsplat.geometry import Similarity
from flowsplat.priors.cameras.same_place import SamePlace

VERSION = 1

Second = Annotated[float, Meta(ge=0, le=1e9)]
Pixels = Annotated[float, Meta(ge=0, le=1e5)]


class ShotFile(TypedDict):
    """A shot in ``shots.json``."""

    start: Second
    end: Second


class PlaceFile(TypedDict):
    """Two shots of one place in ``shots.json``."""

    shots: Annotated[list[Count], Meta(min_length=2, max_length=2)]
    similarity: dict[str, Any]
    matches: Count
    pixels: Pixels
    split_pixels: Pixels


class ShotsFile(TypedDict):
    """What ``shots.json`` holds; ``places`` only once all shots were compared, with a hash of the ``cameras`` that they had."""

    version: Count
    input: Text
    fingerprint: Text
    shots: Annotated[list[ShotFile], Meta(min_length=1)]
    notes: list[Text]
    places: NotRequired[list[PlaceFile]]
    cameras: NotRequired[Text]


@dataclass(frozen=True)
class Shot:
    """A shot of a clip.

    Attributes:
        number: from 1 on.
        start: second of the input; ``end`` alike. Both are frames of the shot.
        path: folder of its run.
    """

    number: int
    start: float
    end: float
    path: Path

    def __str__(self) -> str:
        """``"01 (0.00 to 2.40 s)"``."""
        return f"{self.path.name} ({self.start:.2f} to {self.end:.2f} s)"


@dataclass(frozen=True)
class Place:
    """Two shots that see the same place.

    Attributes:
        first: number of a shot.
        second: of a later one.
        found: how they lie to each other; its similarity takes points and cameras of the first to the coordinates of the second.
    """

    first: int
    second: int
    found: SamePlace

    def __str__(self) -> str:
        """A sentence."""
        return (
            f"Shots {self.first} and {self.second} see the same place: the cameras of both are known in one world, to about "
            f"{max(self.found.split_pixels, self.found.pixels):.1f} pixels by {self.found.matches} points."
        )


@dataclass(frozen=True)
class ShotList:
    """The shots of a clip, sentences on what else was seen of its cuts, and shots of one place (None: not looked for yet, or not
    since cameras of a shot were estimated anew)."""

    shots: list[Shot]
    notes: list[str]
    places: list[Place] | None = None

    @property
    def remarks(self) -> list[str]:
        """All there is to say of them."""
        return [*self.notes, *map(str, self.places or ())]


def read_shots(out: Path) -> ShotList | None:
    """Return the shots whose runs a folder holds; None where it is no such folder.

    Raises:
        InputError: its record is damaged, or of a newer version.
    """
    path = RunPaths(out).shots_record_path
    if not path.exists():
        return None
    record = read_json(path, ShotsFile)
    if record["version"] > VERSION:
        raise InputError(f"{out} was written by a newer flowsplat. Update flowsplat.")
    spans = [(shot["start"], shot["end"]) for shot in record["shots"]]
    times = [second for span in spans for second in span]
    if times != sorted(times):
        raise InputError(f"{path} is damaged: its shots do not follow one another.")
    places = record.get("places")
    known = None if places is None else [_read_place(path, place, len(spans)) for place in places]
    shots = _place_shots(out, spans)
    return ShotList(shots, list(record["notes"]), known if record.get("cameras") == _hash_cameras(shots) else None)


def _hash_cameras(shots: Sequence[Shot]) -> str:
    """Return a hash of the cameras of all shots that have some yet."""
    files = [(str(shot.number), RunPaths(shot.path).scene_path / "cameras.json") for shot in shots]
    return hash_files("", [(name, file) for name, file in files if file.exists()], whole=True)


def write_places(out: Path, places: Sequence[Place]) -> None:
    """Add to the record of a folder which of its shots see the same place.

    Raises:
        InputError: the record is damaged, or cannot be written.
    """
    path = RunPaths(out).shots_record_path
    record, listed = read_json(path, ShotsFile), read_shots(out)
    assert listed is not None
    record["cameras"] = _hash_cameras(listed.shots)
    record["places"] = [
        {
            "shots": [place.first, place.second], "similarity": place.found.similarity.to_json(), "matches": place.found.matches,
            "pixels": place.found.pixels, "split_pixels": place.found.split_pixels,
        }
        for place in places
    ]  # fmt: skip
    write_json(path, record)


def _read_place(path: Path, place: PlaceFile, shots: int) -> Place:
    first, second = place["shots"]
    try:
        similarity = Similarity.from_json(place["similarity"])
    except (ValueError, KeyError, TypeError):
        similarity = None
    if similarity is None or not 1 <= first < second <= shots:
        raise InputError(f"{path} is damaged: what it says of shots of one place is not possible.")
    return Place(first, second, SamePlace(similarity, place["matches"], place["pixels"], place["split_pixels"]))


def resolve_run(out: Path) -> Path:
    """Return the folder of a run that a command is to work on: of a clip with one shot that of the shot.

    Raises:
        InputError: there are several, which the message names.
    """
    found = read_shots(out)
    if found is None:
        return out
    if len(found.shots) > 1:
        names = ", ".join(map(str, found.shots))
        raise InputError(
            f"{out} holds {len(found.shots)} shots, each a run of its own: name one, as {found.shots[0].path}, of {names}."
        )
    return found.shots[0].path


def _place_shots(out: Path, spans: Sequence[tuple[float, float]]) -> list[Shot]:
    digits = max(2, len(str(len(spans))))
    folder = RunPaths(out).shots_path
    return [Shot(k, start, end, folder / f"{k:0{digits}d}") for k, (start, end) in enumerate(spans, 1)]
