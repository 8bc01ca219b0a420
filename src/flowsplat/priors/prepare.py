"""All priors of a scene, in order: given ones first, then what is missing."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from flowsplat.common.progress import say
from flowsplat.priors.cameras import CameraOptions, camera_stage
from flowsplat.priors.depth import depth_stage
from flowsplat.priors.depth.clip import forget_solutions
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.given import GivenPriors, use_given, use_truth
from flowsplat.priors.masks import mask_stage
from flowsplat.priors.tracks import tracks_stage
from flowsplat.scenes import Scene


@dataclass(frozen=True)
class PriorsOptions:
    """Where the priors come from."""

    priors: Literal["own", "true"] = "own"
    """``own`` computes them from the frames; ``true`` takes those of a rendered scene, as far as it has them."""
    given: GivenPriors = field(default_factory=GivenPriors)
    """Your own files, which take the place of either."""
    cameras: CameraOptions = field(default_factory=CameraOptions)
    """How cameras are computed."""


def prepare_priors(scene: Scene, options: PriorsOptions) -> dict[str, float]:
    """Complete the priors of a scene; those that are there are kept.

    Returns:
        Seconds of every stage that ran.

    Raises:
        InputError: a given file does not fit, the scene has no truth, or no cameras can be found.
    """
    stages: list[tuple[str, Callable[[], None]]] = [
        ("cameras", lambda: camera_stage(scene, options.cameras)),
        ("flow", lambda: flow_stage(scene)),
        ("masks", lambda: mask_stage(scene)),
        ("depth", lambda: depth_stage(scene)),
        ("tracks", lambda: tracks_stage(scene)),
    ]
    missing = [name for name, _ in stages if scene.prior(name) is None]
    seconds: dict[str, float] = {}
    if options.priors == "true" and missing:
        seconds["truth"] = _timed(lambda: use_truth(scene))
    if options.given != GivenPriors() and missing:
        seconds["given"] = _timed(lambda: use_given(scene, options.given))
    for name, stage in stages:
        if scene.prior(name) is None:
            seconds[name] = _timed(stage)
            say(f"{name}: {_verdict(scene, name)} ({seconds[name]:.0f} s)")
    forget_solutions(scene)
    _ = scene.similarity  # Computed and stored here, so that training and evaluation share it.
    return seconds


def _timed(stage: Callable[[], None]) -> float:
    start = time.perf_counter()
    stage()
    return time.perf_counter() - start


def _verdict(scene: Scene, name: str) -> str:
    prior = scene.prior(name) or {}
    return str(prior.get("verdict", prior.get("method", "done")))
