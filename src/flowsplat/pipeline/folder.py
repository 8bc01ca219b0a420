"""The folder of a run, and its record of finished stages.

run.json          input, its fingerprint, all settings, and which stages are finished with which key
scene/            the prepared scene
coarse/           a coarse scene of few small frames, shown until training has a checkpoint
priors.html       cameras, depth, masks, flow and tracks to look at, with a verdict
training/         checkpoints (while training), history.json
model/            the trained 4D scene: what is measured
model_all_frames/ the same scene fitted to the held-out frames, too, with the priors of those: what videos and exports show
model_one_color/  what is shown, fitted to one color a Gaussian: for formats that hold no more
static/           our own static scene to compare with (--baselines all)
logs/             TensorBoard
preview.png       a training view beside its target, refreshed while training
evaluation/       held-out renderings
renders/          videos
export/           what flowsplat export and tracks write
metrics.json      figures
report.html       all of it to look at
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta
from typing_extensions import NotRequired, TypedDict

from flowsplat import __version__
from flowsplat.common.errors import InputError, WritingError
from flowsplat.common.files import check_json, make_folder, read_json, write_json
from flowsplat.common.files.json_file import Count, Number, Positive, Text, Versioned
from flowsplat.common.files.lease import NAME as LOCK
from flowsplat.common.memory import begin_peak, get_recent_peak, give_back_memory, peak_memory
from flowsplat.common.run_paths import RunPaths
from flowsplat.common.settings import from_plain, to_plain
from flowsplat.output.videos import SwingFile
from flowsplat.pipeline.config import RunConfig

VERSION = 4

Seconds = Annotated[float, Meta(ge=0, le=1e9)]


class StageFile(TypedDict):
    """A finished stage in ``run.json``."""

    key: Text
    seconds: dict[str, Seconds]
    peak_memory_gib: NotRequired[Number | None]
    parts_memory_gib: NotRequired[dict[str, Number | None]]
    scene: NotRequired[Text | None]


class RunFile(TypedDict):
    """What ``run.json`` holds; more may stand there."""

    input: Text
    fingerprint: Text
    config: dict[str, Any]
    started: dict[str, Text]
    stages: dict[str, StageFile]
    unfinished: NotRequired[dict[str, dict[str, Seconds]]]
    wall_seconds: Seconds


class AreaScores(TypedDict):
    """The figures of a part of some images in ``metrics.json``; more may stand there."""

    psnr: Number | None
    ssim: Number | None
    lpips: NotRequired[Number | None]
    detail: NotRequired[Number | None]
    contrast: NotRequired[Number | None]
    count: NotRequired[Count | None]


class Scores(AreaScores):
    """The figures of some images, and of parts of them."""

    moving: NotRequired[AreaScores | None]
    covisible: NotRequired[AreaScores | None]


class ErrorFile(TypedDict):
    """Errors of flow or depth in ``metrics.json``."""

    mean: Number | None
    median: Number | None
    moving: NotRequired[dict[str, Number | None] | None]


class GaussiansFile(TypedDict):
    """How many Gaussians there are, in all and in every frame."""

    total: Count
    active_mean: Number
    active: list[Count]
    objects: NotRequired[dict[str, Count]]


class ObjectFigures(TypedDict):
    """An object in ``metrics.json``; more may stand there."""

    depth: Positive
    sigma: Positive
    largest_step: Positive
    cues: list[Text]
    small: NotRequired[bool]
    number: NotRequired[int]
    hint: NotRequired[Text | None]


class MetricsFile(TypedDict, total=False):
    """What is shown of ``metrics.json``."""

    heldout_frames: Scores | None
    heldout_frames_refined: Scores | None
    heldout_views: Scores | None
    heldout_views_refined: Scores | None
    training_frames: Scores | None
    baselines: dict[str, Scores | None] | None
    baselines_views: dict[str, Scores | None] | None
    flow_epe: ErrorFile | None
    prior_flow_epe: ErrorFile | None
    flow_prior_epe: ErrorFile | None
    depth_abs_rel: dict[str, dict[str, Number | None] | None] | None
    lpips_reason: Text | None
    gaussians: GaussiansFile
    objects: list[ObjectFigures]
    orbit: SwingFile | None
    seconds: dict[str, Seconds]
    wall_seconds: Seconds
    peak_memory_gib: Number | None
    memory_gib: dict[str, Number | None]
    shown: Text


class Stage:
    """A stage of a run that is at work, see ``RunFolder.stage``.

    Attributes:
        is_done: nothing is left to do: it was finished with this key, and what it made is there.
    """

    def __init__(self, folder: RunFolder, name: str, key: str, is_done: bool):
        self.is_done, self._folder, self._name, self._key = is_done, folder, name, key
        self._started = time.perf_counter()
        self._earlier: dict[str, float] = folder.record.setdefault("unfinished", {}).get(name, {})

    def note(self, seconds: Mapping[str, float]) -> None:
        """Note what parts of it took so far, so that it counts when it goes on another time."""
        self._folder.record["unfinished"][self._name] = self._add_earlier(seconds)
        self._folder.save()

    def _add_earlier(self, seconds: Mapping[str, float]) -> dict[str, float]:
        parts = {**self._earlier, **seconds}
        return {name: round(self._earlier.get(name, 0.0) + seconds.get(name, 0.0), 2) for name in parts}

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds since it began, by its name."""
        return {self._name: time.perf_counter() - self._started}

    def finish(self, seconds: Mapping[str, float] | None = None, memory: Mapping[str, float | None] | None = None) -> None:
        """Note that it is finished.

        Args:
            seconds: of its parts, to which that is added which was noted before it was stopped; None = all since it began.
            memory: GiB that parts of it needed, where its memory was counted anew for each.
        """
        took = self._add_earlier(self.seconds if seconds is None else seconds)
        self._folder._finish(self._name, self._key, took, memory)


class RunFolder(RunPaths):
    """One run: where its parts are, what is finished, and with which settings."""

    def __init__(self, path: Path):
        """Open the folder of a run that was started before.

        Raises:
            InputError: it is none, is damaged, or of another version.
        """
        super().__init__(path)
        self._begun = time.perf_counter()
        if not self.record_path.exists():
            raise InputError(f"{path} is not the folder of a run: it has no run.json. Start with flowsplat run INPUT -o {path}.")
        self.record: dict[str, Any] = read_json(self.record_path, Versioned)
        if self.record["version"] > VERSION:
            raise InputError(f"{path} was written by a newer flowsplat. Update flowsplat.")
        if self.record["version"] < VERSION:
            raise InputError(f"{path} is a run of an earlier flowsplat, which this one does not go on with: choose another folder.")
        check_json(self.record_path, self.record, RunFile)
        self.fingerprint: str = self.record["fingerprint"]
        self._earlier: float = self.record["wall_seconds"]
        try:
            self.config = from_plain(RunConfig, self.record["config"])
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{self.record_path} is damaged: {error}.") from error

    @staticmethod
    def open_or_create(path: Path, source: str, fingerprint: str, config: RunConfig) -> RunFolder:
        """Return the run of this input in this folder, with these settings from now on.

        Raises:
            InputError: the folder cannot be written, holds something else, or belongs to a different input.
        """
        path, record = Path(path), RunPaths(path).record_path
        if record.exists():
            folder = RunFolder(path)
            if folder.fingerprint != fingerprint:
                raise InputError(
                    f"{path} belongs to a different input ({folder.record['input']}) or to other input options. "
                    "Choose another folder with -o."
                )
            folder.config = config
        else:
            make_folder(path)
            if any(entry.name != LOCK for entry in path.iterdir()):
                raise InputError(f"{path} is not empty and not the folder of a run. Choose another folder with -o.")
            write_json(record, _new_record(source, fingerprint, config))
            folder = RunFolder(path)
        if not os.access(path, os.W_OK):
            raise WritingError(f"No permission to write {path}. Choose another output folder with -o.")
        folder.save()
        return folder

    def save(self) -> None:
        """Write the record."""
        self.record["config"], self.record["wall_seconds"] = to_plain(self.config), round(self.wall_seconds, 2)
        write_json(self.record_path, self.record)

    # -- stages

    def is_finished(self, stage: str, key: str) -> bool:
        """Return whether a stage was finished with exactly this key."""
        return bool(self.record["stages"].get(stage, {}).get("key") == key)

    def is_of_scene(self, stage: str) -> bool:
        """Return whether a stage was finished, with whatever settings, and the scene was not prepared anew since."""
        entry = self.record["stages"].get(stage)
        return entry is not None and entry.get("scene", self._scene_key) == self._scene_key

    @property
    def _scene_key(self) -> str | None:
        """The key with which the scene was prepared; None while it is not finished."""
        key: str | None = self.record["stages"].get("prepare", {}).get("key")
        return key

    def was_started(self, stage: str, key: str) -> bool:
        """Return whether a stage was begun with exactly this key, so that what it left can be used."""
        return bool(self.record["started"].get(stage) == key)

    def forget(self, stage: str) -> None:
        """Note that nothing of a stage can be used: to be said before any of it is deleted."""
        for known in ("stages", "started", "unfinished"):
            self.record.get(known, {}).pop(stage, None)
        self.save()

    @contextlib.contextmanager
    def stage(
        self, name: str, key: str, owns: Sequence[Path] = (), drops: Sequence[str] = (), made: bool = True
    ) -> Iterator[Stage]:
        """Do a stage: not where it is finished with this key, from where it stopped if it was begun with it, else from nothing.

        Whoever works calls ``finish`` of what this gives; left without that, by an error or an interrupt, it goes on next time.

        Args:
            key: everything that what it makes depends on (``stage_key``).
            owns: folders and files that are of it alone, and are deleted where it begins from nothing.
            drops: stages whose results belong to those of this one: they are forgotten then, too.
            made: whether what it makes is there, if it was finished.
        """
        is_done = self.is_finished(name, key) and made
        if not is_done:
            if not self.was_started(name, key):
                for stage in (name, *drops):
                    self.forget(stage)
                for path in owns:
                    if path.is_file():
                        path.unlink()
                    shutil.rmtree(path, ignore_errors=True)
            give_back_memory()
            begin_peak()
            self.record["stages"].pop(name, None)
            self.record["started"][name] = key
            self.save()
        yield Stage(self, name, key, is_done)

    def _finish(self, stage: str, key: str, took: Mapping[str, float], parts: Mapping[str, float | None] | None) -> None:
        peak = max((gib for gib in (get_recent_peak(), *(parts or {}).values()) if gib is not None), default=None)
        self.record["unfinished"].pop(stage, None)
        self.record["stages"][stage] = {"key": key, "seconds": dict(took), "peak_memory_gib": peak, "scene": self._scene_key}
        if parts:
            self.record["stages"][stage]["parts_memory_gib"] = dict(parts)
        self.save()

    @property
    def wall_seconds(self) -> float:
        """Seconds that passed while commands worked on this run, this one included, whatever they did in them."""
        return self._earlier + time.perf_counter() - self._begun

    def count_from(self, begun: float) -> None:
        """Let the time of this command count from an earlier ``time.perf_counter()``."""
        self._begun = begun

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of all finished parts of all finished stages."""
        return {name: value for stage in self.record["stages"].values() for name, value in stage["seconds"].items()}

    @property
    def memory(self) -> dict[str, float | None]:
        """GiB that each finished stage needed at most, and parts of it; None where the system did not tell."""
        stages = self.record["stages"].items()
        parts = {name: gib for _, stage in stages for name, gib in stage.get("parts_memory_gib", {}).items()}
        return {name: stage.get("peak_memory_gib") for name, stage in stages} | parts

    @property
    def peak_memory(self) -> float | None:
        """GiB that this process and those that finished a stage needed at most; None where the system does not tell."""
        peaks = [peak_memory(), *(stage.get("peak_memory_gib") for stage in self.record["stages"].values())]
        return max((peak for peak in peaks if peak is not None), default=None)


def stage_key(*parts: Any) -> str:
    """Return a short hash of everything that a stage depends on."""
    text = json.dumps([to_plain(part) for part in parts], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _new_record(source: str, fingerprint: str, config: RunConfig) -> dict[str, Any]:
    return {
        "version": VERSION, "flowsplat": __version__, "input": source, "fingerprint": fingerprint,
        "config": to_plain(config), "started": {}, "stages": {}, "wall_seconds": 0.0,
    }  # fmt: skip
