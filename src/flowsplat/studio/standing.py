"""Read how far a run is: from its record, and from the last lines that it said."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat.common.files import ordinary_file, read_bytes, read_json
from flowsplat.common.run_paths import RunPaths
from flowsplat.pipeline.folder import RunFile

MAX_TAIL_BYTES = 16_384
"""Bytes at the end of a log that are read. Chosen by eye."""
STAGES = ("cameras", "priors", "train", "rest")
"""As ``pipeline.speed`` estimates them."""
SAYS = {
    "cameras": "Finding out how the camera moved", "priors": "Finding out what moves, and how far away things are",
    "train": "Building the scene", "rest": "Measuring, and making videos",
}  # fmt: skip
"""What a stage is called on the page."""
MIN_SHARE_LEFT = 0.1
"""Of the time that was expected of a stage: it is never said to be shorter than that before it ends. Chosen by eye."""

LATE_FACTOR, LATE_SECONDS = 1.8, 10.0
"""A stage may take so many times what was expected, and so much more, before no time is told any more. The first is what
``pipeline.speed`` leaves open before anything was measured."""

_BAR = re.compile(r"(?P<label>[^:]{1,80}): (?P<done>[0-9.e+]{1,12}) of (?P<total>[0-9.e+]{1,12})(?P<rest>,.*|\s.*|)")
_ORBIT_OR_SHOT = re.compile(
    r"^(?P<begins>\$ flowsplat \S+|Shot (?P<shot>[0-9]{1,4}) of [0-9]{1,4}: )|"
    r"Orbit: (?P<degrees>[0-9]{1,4}(?:\.[0-9]{1,4})?) degrees to either side(?:.{0,40}; (?P<guess>[0-9]{1,3})% of what it shows)?",
    re.MULTILINE,
)


@dataclass(frozen=True)
class Standing:
    """How far a run is.

    Attributes:
        scene: which of its scenes it works on, from 0.
        stage: one of ``STAGES``.
        line: what it said last.
        share: of its time that has passed, 0 to 1; None where no time was expected.
        seconds_left: until all is done; likewise, and None where a stage has taken longer than can be explained.
        is_late: whether it has.
    """

    scene: int
    stage: str
    line: str
    share: float | None
    seconds_left: float | None
    is_late: bool = False


class StandingReader:
    """Follows one run: when the stage that works began, it remembers."""

    def __init__(self) -> None:
        self._stage = (-1, "", 0.0, 0.0)

    def read(self, runs: Sequence[RunPaths], log: Path, since: float, expected: Sequence[Mapping[str, float]]) -> Standing:
        """Return how far the run is that a process works on since ``since`` (``time.time()``).

        Args:
            runs: of its scenes, one after the other.
            expected: of each scene, seconds of each stage, and of compiling before that.
        """
        scene = _find_scene(runs, since)
        stage, lines = _find_stage(runs[scene], since), read_last_lines(log)
        line = lines[-1] if lines else "Starting"
        # A run that is made anew with other clicks begins with the record of the whole one: stages may go back.
        if self._stage[:3] != (scene, stage, since):
            self._stage = scene, stage, since, since if (scene, stage) == (0, STAGES[0]) else time.time()
        began = self._stage[3]
        if scene >= len(expected):
            return Standing(scene, stage, line, None, None)
        all_times = [_times_of(each) for each in expected]
        times = all_times[scene]
        done = _read_share(line) if stage == "train" else None
        spent = time.time() - began
        is_late = done is None and spent > LATE_FACTOR * times[stage] + LATE_SECONDS
        left = times[stage] * (1 - done) if done is not None else max(times[stage] - spent, MIN_SHARE_LEFT * times[stage])
        left += sum(times[name] for name in STAGES[STAGES.index(stage) + 1 :])
        left += sum(sum(later.values()) for later in all_times[scene + 1 :])
        whole = max(sum(sum(each.values()) for each in all_times), 1e-6)
        return Standing(scene, stage, line, min(max(1 - left / whole, 0.0), 0.99), None if is_late else left, is_late)


def _times_of(expected: Mapping[str, float]) -> dict[str, float]:
    times = {name: expected.get(name, 0.0) for name in STAGES}
    times["cameras"] += expected.get("compiling", 0.0)
    return times


def _find_scene(runs: Sequence[RunPaths], since: float) -> int:
    """Return which of the runs was written last of those that were since: those before it are done."""
    found = 0
    for k, run in enumerate(runs):
        with suppress(OSError):
            found = k if run.record_path.stat().st_mtime >= since else found
    return found


def _find_stage(run: RunPaths, since: float) -> str:
    """Return the stage that works; the first as long as the record is that of an earlier process."""
    try:
        if run.record_path.stat().st_mtime < since:
            return STAGES[0]
        finished = set(read_json(run.record_path, RunFile)["stages"])
        if "prepare" not in finished:
            priors = read_json(run.scene_path / "scene.json").get("priors", {})
            return "priors" if "cameras" in priors else "cameras"
        return "rest" if "train" in finished else "train"
    except (InputError, AttributeError, OSError):
        return STAGES[0]


def _read_share(line: str) -> float | None:
    found = _BAR.fullmatch(line)
    try:
        return None if found is None else min(max(float(found["done"]) / float(found["total"]), 0.0), 1.0)
    except (ValueError, ZeroDivisionError):
        return None


def read_last_lines(log: Path) -> list[str]:
    """Return the last lines that the last process said, without empty ones; none where there is no log."""
    try:
        size = ordinary_file(log)
        with log.open("rb") as opened:
            opened.seek(max(0, size - MAX_TAIL_BYTES))
            text = opened.read(MAX_TAIL_BYTES).decode(errors="replace")
    except (InputError, OSError):
        return []
    lines = [line.rstrip() for line in text.splitlines() if line.strip()]
    starts = [k for k, line in enumerate(lines) if line.startswith("$ flowsplat ")]
    return lines[starts[-1] + 1 :] if starts else lines


def read_orbits(log: Path) -> dict[int, list[tuple[float, int | None]]]:
    """Return degrees to either side of every orbit that the runs of a log have made, in order, and how many percent of what it
    shows there is a guess, as far as that was said; by the number of the shot, 0 where the clip is one scene."""
    try:
        text = read_bytes(log).decode(errors="replace")
    except InputError:
        return {}
    found: dict[int, list[tuple[float, int | None]]] = {}
    shot = 0
    for match in _ORBIT_OR_SHOT.finditer(text):
        if match["begins"]:
            shot = int(match["shot"] or 0)
        else:
            found.setdefault(shot, []).append((float(match["degrees"]), int(match["guess"]) if match["guess"] else None))
    return found
