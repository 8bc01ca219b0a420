"""Depth: from matches over many frames, from a network, the user's, or true depth."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from flowsplat.priors.depth import depth_stage
from flowsplat.priors.given.depth import GivenDepth, open_depth
from flowsplat.priors.given.fitting import verdict_of
from flowsplat.priors.kinds.cameras import MAKER
from flowsplat.priors.kinds.static_depth import STATIC
from flowsplat.priors.learned.weights import network_device
from flowsplat.priors.monocular import Monocular, monocular_stage
from flowsplat.priors.prior import BROUGHT, GIVEN, Kind, Request, Stage
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import Layers

OWN = "multiview"


def _compute(request: Request) -> Stage:
    scene, estimate = request.scene, request.estimate
    if request.options.depth == OWN:
        return lambda: depth_stage(scene, estimate, request.memory.pop(STATIC))
    from flowsplat.priors.learned.depth import predict_depth

    source = predict_depth(request.options.depth, scene, request.options.models, network_device(request.device))
    return partial(monocular_stage, scene, source, estimate)


def _read_true(scene: Scene, truth: Layers) -> bool:
    for i in scene.train_frames:
        scene.write_depth(i, truth.depth(i))
    return True


def _read_given(request: Request, path: Path) -> Stage | None:
    """Depth in other units than those of the cameras has to be fitted to them."""
    scene, depth = request.scene, open_depth(path, request.scene)
    units_known = request.method("cameras") in BROUGHT
    if request.memory.get(MAKER) in depth.fits or ("any" in depth.fits and units_known):
        for i in scene.train_frames:
            scene.write_depth(i, depth.read(i))
        scene.finish_prior("depth", method=GIVEN, verdict=verdict_of(path, depth.maker))
        return None
    return partial(monocular_stage, scene, _monocular(depth, path), request.estimate)


def _monocular(depth: GivenDepth, path: Path) -> Monocular:
    def inverse(i: int) -> tuple[np.ndarray, np.ndarray]:
        found = depth.read(i)
        return 1 / found.depth, found.confidence

    return Monocular(GIVEN, verdict_of(path, depth.maker), relative=False, inverse=inverse)


DEPTH = Kind(
    compute=_compute,
    options=("depth", "models"),
    files=("depth",),
    own=("multi-view", "guess"),
    asked=lambda request: None if request.options.depth == OWN else request.options.depth,
    finds_flow=True,
    read_true=_read_true,
    asks_truth=lambda request: True,
    read_given=_read_given,
    given_replaces=True,
)
