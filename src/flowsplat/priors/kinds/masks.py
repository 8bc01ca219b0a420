"""Masks of what moves: by its motion, shown by clicks and boxes, followed by a network, the user's, or true ones."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from flowsplat.priors.given.masks import use_masks
from flowsplat.priors.learned.networks import OWN_METHODS
from flowsplat.priors.learned.weights import network_device
from flowsplat.priors.masks import mask_stage
from flowsplat.priors.prior import GIVEN, Kind, PriorRequest, Stage
from flowsplat.priors.prompts import prompt_stage, shows
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import Layers

OWN, CLICKS = OWN_METHODS["masks"], "clicks"


def _compute(request: PriorRequest) -> Stage:
    scene, estimate, prompts = request.scene, request.estimate, request.prompts
    if request.choice("masks") == OWN:
        return partial(prompt_stage, scene, prompts, estimate) if prompts else partial(mask_stage, scene, estimate)
    from flowsplat.priors.learned.sam import load_segmenter, prompts_from_masks, sam_stage

    segmenter = load_segmenter(request.choice("masks"), request.options.models, network_device(request.device))
    if prompts:
        return partial(sam_stage, scene, segmenter, prompts, "clicks and boxes")

    def found_by_motion() -> None:
        mask_stage(scene, estimate)
        sam_stage(scene, segmenter, prompts_from_masks(scene), OWN)

    return found_by_motion


def _get_requested(request: PriorRequest) -> str | None:
    if request.choice("masks") != OWN:
        return request.choice("masks")
    return CLICKS if request.prompts else None


def _differs(request: PriorRequest, asked: str | None) -> bool:
    """Return whether the masks are of other clicks and boxes."""
    return bool(request.prompts) and request.method("masks") == asked and not shows(request.scene, request.prompts)


def _read_true(scene: Scene, truth: Layers) -> bool:
    for i in scene.train_frames:
        scene.write_mask(i, truth.mask(i))
    return True


def _read_given(request: PriorRequest, path: Path) -> None:
    told = use_masks(path, request.scene)
    request.scene.finish_prior("masks", method=GIVEN, verdict=f"from {path}" + (f"; {told}" if told else ""))


MASKS = Kind(
    compute=_compute,
    options=("masks", "mask_click", "mask_box", "mask_negative", "models"),
    files=("masks",),
    own=(OWN,),
    asked=_get_requested,
    differs=_differs,
    finds_flow=True,
    overwrites=True,
    read_true=_read_true,
    asks_truth=lambda request: not request.prompts,  # they are what is true
    read_given=_read_given,
)
