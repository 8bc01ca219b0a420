"""The record of a folder that holds a run of each shot of a clip, and the run in it that a command works on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta
from typing_extensions import TypedDict

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json
from flowsplat.common.files.json_file import Count, Text
from flowsplat.common.run_paths import RunPaths

VERSION = 1

Second = Annotated[float, Meta(ge=0, le=1e9)]


class ShotFile(TypedDict):
    """A shot in ``shots.json``."""

    start: Second
    end: Second


class ShotsFile(TypedDict):
    """What ``shots.json`` holds."""

    version: Count
    input: Text
    fingerprint: Text
    shots: Annotated[list[ShotFile], Meta(min_length=1)]
    notes: list[Text]


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
class ShotList:
    """The shots of a clip, and sentences on what else was seen of its cuts."""

    shots: list[Shot]
    notes: list[str]


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
    return ShotList(_place_shots(out, spans), list(record["notes"]))


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
