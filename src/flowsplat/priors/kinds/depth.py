"""Depth: from matches over many frames, from a network, the user's, or true depth."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from flowsplat.priors.depth import depth_stage
from flowsplat.priors.given.depth import open_depth
from flowsplat.priors.given.depth_check import is_in_units, match_training_frames, monocular_of, require_told
from flowsplat.priors.given.fitting import verdict_of
from flowsplat.priors.kinds.cameras import MAKER
from flowsplat.priors.kinds.object_depth import open_object_depth
from flowsplat.priors.kinds.static_depth import STATIC
from flowsplat.priors.learned.networks import OWN_METHODS
from flowsplat.priors.learned.weights import network_device
from flowsplat.priors.monocular import monocular_stage
from flowsplat.priors.prior import BROUGHT, GIVEN, Kind, PriorRequest, Stage
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import Layers

OWN = OWN_METHODS["depth"]
GUESS = "guess"
"""Method of depth of a clip without parallax, whatever gives it: its scale is free."""


def _compute(request: PriorRequest) -> Stage:
    scene, estimate = request.scene, request.estimate
    if request.choice("depth") == OWN:
        monocular = open_object_depth(request)

        def stage() -> None:
            clip, static = request.memory.pop(STATIC)
            if monocular is None or clip.has_parallax:
                depth_stage(scene, estimate, (clip, static))
            else:
                monocular_stage(scene, replace(monocular(), method=GUESS), estimate, clip)

        return stage
    from flowsplat.priors.learned.depth import predict_depth

    source = predict_depth(request.choice("depth"), scene, request.options.models, network_device(request.device))
    return partial(monocular_stage, scene, source, estimate)


def _read_true(scene: Scene, truth: Layers) -> bool:
    for i in scene.train_frames:
        scene.write_depth(i, truth.depth(i))
    return True


def _read_given(request: PriorRequest, path: Path) -> Stage | None:
    """Return what fits depth to the cameras; None where it is in their units."""
    scene, depth, asked = request.scene, open_depth(path, request.scene), request.options.given.depth_kind
    told = asked or (depth.kind if depth.is_certain else None)
    matches = match_training_frames(scene)
    said = verdict_of(path, depth.maker)
    units_known = request.memory.get(MAKER) in depth.fits or ("any" in depth.fits and request.method("cameras") in BROUGHT)
    if units_known and asked in (None, depth.kind):
        fits = is_in_units(scene, depth, matches)
        if fits is None and told is None:
            require_told(scene, path, matches)
        if fits is not False:
            for i in scene.train_frames:
                scene.write_depth(i, depth.read(i))
            scene.finish_prior("depth", method=GIVEN, verdict=said)
            return None
        said += ", which is not in the units of the cameras"
    if told is None:
        require_told(scene, path, matches)

    def fit() -> None:
        monocular_stage(scene, monocular_of(scene, depth, matches, path, told, said), request.estimate)

    return fit


DEPTH = Kind(
    compute=_compute,
    options=("depth", "models"),
    files=("depth",),
    own=("multi-view", GUESS),
    asked=lambda request: None if request.choice("depth") == OWN else request.choice("depth"),
    finds_flow=True,
    read_true=_read_true,
    asks_truth=lambda request: True,
    read_given=_read_given,
    given_replaces=True,
)
