"""How long a run takes on this machine: from what it took before, or from a test of two seconds.

What was measured is kept in ``speed.json`` in the user's cache folder: by device and number of threads, and in it by stage, how
many times as long as on the reference machine (two cores) the latest runs took. It may be deleted at any time.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
from msgspec import Meta

from flowsplat.common.devices import pick_device
from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_json
from flowsplat.common.progress import busy
from flowsplat.common.user_cache import cache_folder
from flowsplat.pipeline.config import RunConfig
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import Clip
from flowsplat.scenes.scene import split_frames
from flowsplat.training.final import SHARE

Range = tuple[float, float]
"""The least and the most."""
Ratio = Annotated[float, Meta(gt=0, le=1e6)]

STAGES = ("cameras", "priors", "train", "rest")
"""Search of the cameras; all other priors; training; measuring, final fit and videos."""

SHORTEST = 10.0
"""Seconds from which the time of a stage tells something."""
KEPT = 5
"""Runs whose times are remembered."""
MARGIN = 0.25
"""Relative; by how much clips differ that are as large."""
UNTRIED = (0.6, 2.0)
"""What a test of two seconds leaves open, as factors."""
UNTRIED_GPU = (0.05, 1.0)
"""The same on a GPU, which it does not test."""
TEST_SECONDS, REFERENCE_ROUND = 2.0, 0.018
"""How long the test is, and the seconds of one round on the reference machine."""


def expected(scene: Scene, config: RunConfig) -> dict[str, float]:
    """Seconds of every stage on the reference machine."""
    return _expected(config, scene.width, scene.height, len(scene.train_frames), len(scene.heldout_frames))


def expected_of(clip: Clip, config: RunConfig) -> dict[str, float]:
    """The same of a clip that is no scene yet."""
    train, heldout = split_frames(clip.num_frames, None if clip.num_views else config.input.holdout)
    return _expected(config, clip.width, clip.height, len(train), len(heldout))


def _expected(config: RunConfig, width: int, height: int, train_frames: int, heldout: int) -> dict[str, float]:
    megapixels = width * height / 1e6
    all_frames = (train_frames + heldout) * megapixels
    frames = config.train.frames_per_iteration or train_frames
    train = config.train.iterations * frames * (0.01 + 0.48 * megapixels)
    final = SHARE * train if config.final_fit and heldout else 0.0
    static = 0.25 * train if config.baselines == "all" else 0.0
    return {
        "cameras": 3 + 0.17 * all_frames, "priors": 15 + 4.2 * all_frames, "train": train,
        "rest": 5 + 1.5 * all_frames + final + static,
    }  # fmt: skip


def expected_memory(width: int, height: int, train_frames: int) -> float:
    """GiB that a whole run needs."""
    megapixels = width * height / 1e6
    return 0.6 + 3.4 * megapixels + train_frames * megapixels * 0.02


def stages_of(seconds: Mapping[str, float]) -> dict[str, float]:
    """What a run took, from its seconds by part to those of ``STAGES``; of those that it went through."""
    found: dict[str, float] = {}
    for name, value in seconds.items():
        if name == "first":  # as long in every run
            continue
        stage = name if name in STAGES else "rest" if name in ("static", "evaluate", "final", "render") else "priors"
        found[stage] = found.get(stage, 0.0) + value
    return found


def cache_file() -> Path:
    """``speed.json`` in the user's folder for caches."""
    return cache_folder() / "speed.json"


class Speed:
    """Of this machine on one device. Nothing that is wrong with its file is an error."""

    def __init__(self, device: str):
        """``device``: auto, cpu or cuda."""
        chosen = pick_device(device).type
        self._untried = UNTRIED if chosen == "cpu" else UNTRIED_GPU
        self._all = _read()
        self._known = self._all.setdefault(f"{chosen}, {torch.get_num_threads()} threads", {})
        self._now: float | None = None

    def seen(self, ratio: float) -> None:
        """Note how many times as long as on the reference machine the cameras of the run that goes on took."""
        self._now = ratio

    def remember(self, seconds: Mapping[str, float], reference: Mapping[str, float]) -> None:
        """Keep what the stages of a whole run took; what was short, or not all of its work, tells nothing."""
        for stage, took in stages_of(seconds).items():
            if took >= SHORTEST and (stage != "priors" or {"flow", "depth"} <= set(seconds)):
                self._known[stage] = [*self._known.get(stage, []), round(took / reference[stage], 3)][-KEPT:]
        self._write()

    def factors(self, stage: str) -> Range:
        """How many times as long as on the reference machine a stage takes."""
        known = self._known.get(stage)
        if known:
            return min(known) * (1 - MARGIN), max(known) * (1 + MARGIN)
        if not self._known.get("test"):
            self._known["test"] = [round(self_test(), 3)]
            self._write()
        tested = self._known["test"][0]
        # The time of the cameras depends on the clip, too.
        factor = tested if self._now is None else (tested * self._now) ** 0.5
        return factor * self._untried[0], factor * self._untried[1]

    def estimate(self, reference: Mapping[str, float], stages: Sequence[str] = STAGES) -> Range:
        """Seconds that the stages take together."""
        ranges = [(reference[stage] * least, reference[stage] * most) for stage in stages for least, most in [self.factors(stage)]]
        return sum(least for least, _ in ranges), sum(most for _, most in ranges)

    def _write(self) -> None:
        with contextlib.suppress(InputError):  # then the next run tests again
            make_folder(cache_file().parent)
            write_json(cache_file(), self._all)


def self_test(seconds: float = TEST_SECONDS) -> float:
    """How many times as long as the reference machine this one takes for flow and for arithmetic, which is most of a run."""
    noise = np.random.default_rng(0).integers(0, 255, (260, 440), dtype=np.uint8)
    picture = cv2.GaussianBlur(noise, (0, 0), 2)
    a, b = np.ascontiguousarray(picture[:240, :426]), np.ascontiguousarray(picture[3:243, 5:431])
    flow, numbers = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM), torch.rand(1_000_000)
    took: list[float] = []
    with busy("How fast is this machine?"):
        end = time.perf_counter() + seconds
        while time.perf_counter() < end or len(took) < 3:
            began = time.perf_counter()
            flow.calc(a, b, None)
            values = numbers
            for _ in range(5):
                values = torch.exp(-values * values)
            took.append(time.perf_counter() - began)
    return float(np.median(took)) / REFERENCE_ROUND


def in_words(seconds: Range) -> str:
    """``"40 to 70 seconds"``, ``"3 to 5 minutes"``, ``"1.5 to 3 hours"``; ``"about 4 minutes"`` where both round to the same."""
    least, most = seconds
    size, unit, digits = (1, "second", -1) if most < 100 else (60, "minute", 0) if most < 100 * 60 else (3600, "hour", 1)
    low, high = (max(round(value / size, digits), 0.1 if digits > 0 else 1) for value in (least, most))
    plural = "s" * (high != 1)
    return f"about {high:g} {unit}{plural}" if low == high else f"{low:g} to {high:g} {unit}{plural}"


def _read() -> dict[str, dict[str, list[float]]]:
    try:
        values = read_json(cache_file(), dict[str, dict[str, list[Ratio]]], most=100_000)
    except InputError:
        return {}
    return {key: {stage: [float(ratio) for ratio in ratios] for stage, ratios in own.items()} for key, own in values.items()}
