"""Estimate how long a run takes on this machine: from what it took before, or from a test of two seconds.

What was measured is kept in ``speed.json`` in the user's cache folder: by device and number of threads, and in it by stage, how
many times as long as on the reference machine (two cores) the latest runs took. It may be deleted at any time. Runs during which
kernels were compiled, or other programs needed the machine, are not among them.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import torch
from msgspec import Meta

from flowsplat.common.devices import pick_device
from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_json
from flowsplat.common.kernel_cache import count_compiled_kernels
from flowsplat.common.progress import spinner
from flowsplat.common.threads import open_cv_threads, restore_open_cv
from flowsplat.common.user_cache import cache_folder
from flowsplat.gaussians.initialize import SPACED_SIDE
from flowsplat.pipeline.config import RunConfig
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import Clip
from flowsplat.training.clip_length import adapt_to_length
from flowsplat.training.final import count_final_steps

Ratio = Annotated[float, Meta(gt=0, le=1e6)]

STAGES = ("compiling", "cameras", "priors", "train", "rest")
"""Kernels, in the first run only; search of the cameras; all other priors; training; measuring, final fit and videos."""
COMPILING_SECONDS = 25.0
"""Seconds by which a run is longer on the reference machine when all its kernels have to be compiled beside it."""

MIN_STAGE_SECONDS, MIN_OWN_SECONDS = 10.0, 2.0
"""Seconds from which the time of a stage tells something of other runs, and of the one that goes on. Chosen by eye."""
KEPT_RUNS = 5
"""Runs whose times are remembered. Chosen by eye."""
UNTRIED_FACTOR = 1.8
"""A test of two seconds leaves open by what factor a run takes longer, or shorter, than it says. Chosen by eye."""
UNTRIED_GPU_FACTOR = 4.0
"""The same on a GPU, which it does not test. Chosen by eye."""
ESTIMATE_FACTOR = 1.35
"""The same where something tells: earlier runs, or the first stage of this one. Clips that are as large differ by as much.
Chosen by eye."""
COMMIT_SECONDS = 60.0
"""Seconds of a run after which an estimate has to commit itself to ``ESTIMATE_FACTOR``. Chosen by eye."""
MAX_OTHER_LOAD = 0.15
"""Share of the machine from which on what other programs take makes the time of a stage tell nothing. Chosen by eye."""
TEST_SECONDS, REFERENCE_ROUND = 2.0, 0.022
"""How long the test is, and the seconds of one round on one core of the reference machine."""


@dataclass(frozen=True)
class TimeEstimate:
    """How long something will take.

    Attributes:
        expected: seconds.
        factor: by which it may take longer, or shorter.
    """

    expected: float
    factor: float

    def __str__(self) -> str:
        """``"about 50 seconds (40 to 70)"``, ``"about 4 minutes (3 to 5)"``, ``"about 2.1 hours (1.6 to 2.8)"``."""
        size, unit, digits = 1, "second", -1
        if self.expected >= 100:
            size, unit, digits = (60, "minute", 0) if self.expected < 100 * 60 else (3600, "hour", 1)
        least = 10.0**-digits
        low, middle, high = (max(round(self.expected * by / size, digits), least) for by in (1 / self.factor, 1, self.factor))
        between = "" if low == high else f" ({low:g} to {high:g})"
        return f"about {middle:g} {unit}{'s' * (middle != 1)}{between}"


def estimate_seconds(scene: Scene, config: RunConfig, compiling: bool = False) -> dict[str, float]:
    """Return seconds of every stage on the reference machine; ``compiling``: with kernels that are not compiled yet."""
    found = _estimate_seconds(config, scene.width, scene.height, len(scene.train_frames), len(scene.heldout_frames))
    return {"compiling": COMPILING_SECONDS if compiling else 0.0, **found}


def estimate_seconds_of_clip(clip: Clip, config: RunConfig) -> dict[str, float]:
    """Return the same of a clip that is no scene yet."""
    train, heldout = clip.split(config.input)
    return _estimate_seconds(config, clip.width, clip.height, len(train), len(heldout))


def estimate_seconds_with(scene: Scene, config: RunConfig, frames: int) -> dict[str, float]:
    """Return the same of so many frames in place of those of the scene, as large a share of them held out."""
    heldout = round(frames * len(scene.heldout_frames) / scene.num_frames)
    return {"compiling": 0.0, **_estimate_seconds(config, scene.width, scene.height, frames - heldout, heldout)}


def _estimate_seconds(config: RunConfig, width: int, height: int, train_frames: int, heldout: int) -> dict[str, float]:
    megapixels = width * height / 1e6
    all_frames = (train_frames + heldout) * megapixels
    steps = adapt_to_length(config.train, train_frames + heldout).iterations
    frames = config.train.frames_per_iteration or train_frames
    # Seven tenths of what a step takes for its pixels are the Gaussians', of which large frames have fewer (bear at 854 pixels).
    spread = max(1.0, max(width, height) / SPACED_SIDE) ** (-2 * config.train.init.spacing_growth)
    train = steps * frames * (0.01 + 0.48 * megapixels * (0.3 + 0.7 * spread))
    share = count_final_steps(steps, heldout) / max(steps, 1) if heldout else 0.0
    final = share * train if config.final_fit else 0.0
    static = 0.25 * train if config.baselines == "all" else 0.0
    own = config.priors.priors != "true"  # what is true is there
    return {
        "cameras": own * (3 + 0.17 * all_frames), "priors": own * (15 + 4.2 * all_frames), "train": train,
        "rest": 5 + 1.5 * all_frames + final + static,
    }  # fmt: skip


def estimate_memory(width: int, height: int, train_frames: int) -> float:
    """Return GiB that a whole run needs."""
    megapixels = width * height / 1e6
    return 0.6 + 3.4 * megapixels + train_frames * megapixels * 0.02


def stages_of(seconds: Mapping[str, float]) -> dict[str, float]:
    """Return what a run took, from its seconds by part to those of ``STAGES``; of those that it went through."""
    found: dict[str, float] = {}
    for name, value in seconds.items():
        if name in ("coarse", "one_color"):  # as long in every run; made for an export
            continue
        stage = name if name in STAGES else "rest" if name in ("static", "evaluate", "all_frames", "render") else "priors"
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
        self._untried = UNTRIED_FACTOR if chosen == "cpu" else UNTRIED_GPU_FACTOR
        self._all = _read()
        self._known = self._all.setdefault(f"{chosen}, {torch.get_num_threads()} threads", {})
        self._now: list[float] = []

    def note(self, ratio: float) -> None:
        """Note how many times as long as on the reference machine a stage of the run that goes on took."""
        self._now.append(ratio)

    def remember(self, seconds: Mapping[str, float], reference: Mapping[str, float]) -> None:
        """Keep what the stages of a whole run took; what was short, or not all of its work, tells nothing."""
        for stage, took in stages_of(seconds).items():
            if took >= MIN_STAGE_SECONDS and reference[stage] > 0 and (stage != "priors" or {"flow", "depth"} <= set(seconds)):
                self._known[stage] = [*self._known.get(stage, []), round(took / reference[stage], 3)][-KEPT_RUNS:]
        self._write()

    def factor(self, stage: str) -> float:
        """Return how many times as long as on the reference machine a stage takes: as in earlier runs, or by what is known now."""
        if known := self._known.get(stage):
            return float(np.median(known))
        if not self._known.get("test"):
            self._known["test"] = [round(self_test(), 3)]
            self._write()
        # The time of a stage depends on the clip, too.
        return float(np.exp(np.mean(np.log([self._known["test"][0], *self._now]))))

    def estimate(self, reference: Mapping[str, float], stages: Sequence[str] = STAGES, passed: float = 0.0) -> TimeEstimate:
        """Return what the stages take together; ``passed``: seconds since the run began. After a minute who waits wants to know."""
        seconds = {stage: reference[stage] * self.factor(stage) for stage in stages if reference[stage] > 0}
        tried = (
            passed >= COMMIT_SECONDS or bool(self._now) or all(self._known.get(stage) for stage in seconds if stage != "compiling")
        )
        return TimeEstimate(sum(seconds.values()), ESTIMATE_FACTOR if tried else self._untried)

    def _write(self) -> None:
        with contextlib.suppress(InputError):  # then the next run tests again
            make_folder(cache_file().parent)
            write_json(cache_file(), self._all)


@dataclass(frozen=True)
class _Used:
    """Processor seconds since the machine started, of all programs, and of this one and those that it waited for; the time."""

    all: float
    own: float
    now: float


class Watch:
    """What happens on this machine beside a run, from one question to the next."""

    def __init__(self) -> None:
        self._compiled, self._used = count_compiled_kernels(), _read_used()

    def was_quiet(self) -> bool:
        """Whether, since the last time, this process compiled nothing and other programs left the machine alone."""
        compiled, before = self._compiled, self._used
        self._compiled, self._used = count_compiled_kernels(), _read_used()
        if compiled != self._compiled:
            return False
        if before is None or self._used is None:
            return True
        others = self._used.all - before.all - (self._used.own - before.own)
        return others < MAX_OTHER_LOAD * (os.cpu_count() or 1) * max(self._used.now - before.now, 1e-3)


def _read_used() -> _Used | None:
    """None where the system does not tell."""
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
        user, nice, system, _, _, irq, softirq = (int(field) for field in fields[:7])
    except (OSError, ValueError):
        return None
    times = os.times()
    seconds = (user + nice + system + irq + softirq) / os.sysconf("SC_CLK_TCK")
    return _Used(seconds, times.user + times.system + times.children_user + times.children_system, time.monotonic())


def self_test(seconds: float = TEST_SECONDS) -> float:
    """Return how many times as long as the reference machine one core of this one takes for flow and arithmetic, most of a run."""
    noise = np.random.default_rng(0).integers(0, 255, (260, 440), dtype=np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 2)
    a, b = np.ascontiguousarray(image[:240, :426]), np.ascontiguousarray(image[3:243, 5:431])
    flow, numbers = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM), torch.rand(1_000_000)
    took: list[float] = []
    threads = torch.get_num_threads()
    open_cv_threads()  # before they are changed
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        with spinner("How fast is this machine?"):
            end = time.perf_counter() + seconds
            while time.perf_counter() < end or len(took) < 3:
                began = time.thread_time()  # what else runs here costs time, but not of this
                flow.calc(a, b, None)
                values = numbers
                for _ in range(5):
                    values = torch.exp(-values * values)
                took.append(time.thread_time() - began)
    finally:
        torch.set_num_threads(threads)
        restore_open_cv()
    return float(np.median(took)) / REFERENCE_ROUND


def _read() -> dict[str, dict[str, list[float]]]:
    try:
        values = read_json(cache_file(), dict[str, dict[str, list[Ratio]]], most=100_000)
    except InputError:
        return {}
    return {key: {stage: [float(ratio) for ratio in ratios] for stage, ratios in own.items()} for key, own in values.items()}
