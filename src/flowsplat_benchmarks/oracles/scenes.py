"""Oracle scenes: copies of a prepared scene in which one prior after the other is replaced by the truth.

| oracle | what is true in it |
| --- | --- |
| own | nothing: the priors as they are |
| constant | the depth of every object is multiplied by one number, so that its median over the clip is right |
| depth trajectory | objects are flat billboards at the median of their true depth in every frame |
| shape offset | true depth inside the scene's masks |
| outline | true masks, too |
| background | the depth of what rests, too |
| flow | true flow, too |
| cameras | everything, tracks included |

Each holds what is true in those before it. True depth comes at the scale of the estimated cameras (``objects.depth_scale``) as long
as these are used. What the pipeline makes from something that was replaced is made anew: static depth and tracks from the true
masks, tracks from true static depth and from true flow.

A second chain begins with own priors, too, and takes faults off the masks one by one (``mended_masks``). All depth is our own, made
anew from these masks:

| oracle | what is true in it |
| --- | --- |
| ids | every pixel of our masks has the number of its true object |
| shadow | what rests is in no mask: shadows, and what else is taken for moving |
| parts | objects that we found in a frame are whole there |
| masks | all masks are true: objects and frames that we did not find, too |
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.pipeline.preparing import copy_scene
from flowsplat.priors.given import consecutive_pairs
from flowsplat.priors.graph import PRIORS
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors, use_truth
from flowsplat.scenes import Depth, Scene
from flowsplat_benchmarks.oracles.mended_masks import FAULTS, mend_masks
from flowsplat_benchmarks.oracles.objects import depth_scale, masks_of, match_objects, object_depth_errors, truth_of


def require_oracles(names: Sequence[str]) -> None:
    """Check that there are such oracles.

    Raises:
        InputError: there is none of a name.
    """
    for name in names:
        if name not in ORACLES:
            raise InputError(f"There is no oracle {name!r}: choose from {', '.join(ORACLES)}.")


def make_oracle(prepared: Path, folder: Path, oracle: str, device: str = "auto") -> Scene:
    """Return the oracle of a prepared scene in ``folder``; made anew where it is one of another scene. ``prepared`` stays as it is.

    Args:
        oracle: a name from ``ORACLES``.
        device: where the priors that have to be made anew are computed.

    Raises:
        InputError: there is no such oracle, the scene is not prepared or has no truth, or the folder cannot be written.
    """
    require_oracles([oracle])
    source = Scene(prepared)
    truth_of(source)
    identity = {"name": oracle, "of": source.name, "priors": source.info.priors, "similarity": source.info.similarity}
    if (folder / "scene.json").exists():
        if Scene(folder).info.oracle == identity:
            return Scene(folder)
        shutil.rmtree(folder)
    making = folder.with_name(f".{folder.name}.making")
    shutil.rmtree(making, ignore_errors=True)
    scene = copy_scene(prepared, making)
    scene.mark_oracle(f"{source.name}, {oracle}", identity)
    ORACLES[oracle](scene, device)
    making.rename(folder)
    return Scene(folder)


# -- depth inside the scene's own masks


def _as_it_is(scene: Scene, device: str) -> None:
    pass


def _constant(scene: Scene, device: str) -> None:
    errors = object_depth_errors(scene)
    for i, mask, _ in masks_of(scene):
        depth = scene.depth(i)
        values = depth.depth.copy()
        for error in errors:
            values[error.matched.region(mask)] *= np.float32(np.exp(-error.constant))
        scene.write_depth(i, Depth(values, depth.confidence))
    _finish(scene, device, depth="the depth of each object times one number")


def _depth_trajectory(scene: Scene, device: str) -> None:
    objects, scale, truth = match_objects(scene), depth_scale(scene), truth_of(scene)
    for i, mask, true_mask in masks_of(scene):
        depth, true = scene.depth(i), truth.depth(i).depth
        values = depth.depth.copy()
        for obj in objects:
            region, compared = obj.region(mask), obj.select_compared(mask, true_mask)
            if region.any():
                values[region] = scale * np.median(true[compared if compared.any() else region])
        scene.write_depth(i, Depth(values, depth.confidence))
    _finish(scene, device, depth="objects are billboards at their true distance")


def _shape_offset(scene: Scene, device: str) -> None:
    _write_true_depth_of_objects(scene, depth_scale(scene))
    _finish(scene, device, depth="true depth of objects")


def _write_true_depth_of_objects(scene: Scene, scale: float) -> None:
    truth = truth_of(scene)
    for i in scene.train_frames:
        depth, moving = scene.depth(i), scene.mask(i) > 0
        true = np.float32(scale) * truth.depth(i).depth
        scene.write_depth(i, Depth(np.where(moving, true, depth.depth), np.where(moving, np.float32(1), depth.confidence)))


# -- what is replaced beside it


def _outline(scene: Scene, device: str) -> None:
    scale = depth_scale(scene)
    _write_true_masks(scene)
    PRIORS.erase(scene, ["depth", "tracks"])
    _finish(scene, device)
    _write_true_depth_of_objects(scene, scale)
    _finish(scene, device, depth="true depth of objects")


def _train_background(scene: Scene, device: str) -> None:
    _write_true_depth(scene)
    PRIORS.erase(scene, ["tracks"])
    _finish(scene, device)


def _flow(scene: Scene, device: str) -> None:
    _write_true_depth(scene)
    truth = truth_of(scene)
    known = set(truth.flow_pairs)
    for pair in consecutive_pairs(scene):
        if pair in known:
            scene.write_flow(truth.flow(*pair))
    scene.finish_prior("flow", method="truth", verdict="true flow")
    PRIORS.erase(scene, ["tracks"])
    _finish(scene, device)


def _cameras(scene: Scene, device: str) -> None:
    use_truth(scene)
    _finish(scene, device)


def _mend(fault: str, scene: Scene, device: str) -> None:
    for i, mask in mend_masks(scene, fault):
        scene.write_mask(i, mask)
    # Called true, so that the object stage leaves their numbers as they are.
    scene.finish_prior("masks", method="truth", verdict=FAULTS[fault])
    PRIORS.erase(scene, ["depth", "tracks"])
    _finish(scene, device)


def _write_true_masks(scene: Scene) -> None:
    truth = truth_of(scene)
    for i in scene.train_frames:
        scene.write_mask(i, truth.mask(i))
    scene.finish_prior("masks", method="truth", verdict="true masks")


def _write_true_depth(scene: Scene) -> None:
    """And true masks."""
    scale, truth = depth_scale(scene), truth_of(scene)
    _write_true_masks(scene)
    for i in scene.train_frames:
        true = truth.depth(i)
        scene.write_depth(i, Depth(np.float32(scale) * true.depth, true.confidence))
    scene.finish_prior("depth", method="truth", verdict="true depth")


# -- what the scene records


def _finish(scene: Scene, device: str, **verdicts: str) -> None:
    """Note what is true in a prior that was replaced in part, compute those that are missing, and the scale of training."""
    for name, verdict in verdicts.items():
        scene.amend_prior(name, verdict=verdict)
    scene.write_similarity(None)
    prepare_priors(scene, PriorsOptions(), device)


ORACLES: dict[str, Callable[[Scene, str], None]] = {
    "own": _as_it_is, "constant": _constant, "depth_trajectory": _depth_trajectory, "shape_offset": _shape_offset,
    "outline": _outline,
    "background": _train_background, "flow": _flow, "cameras": _cameras, **{fault: partial(_mend, fault) for fault in FAULTS},
}  # fmt: skip
"""What makes each oracle of a copy of the prepared scene, in the order in which those of ``CHAINS`` add to each other."""

CHAINS = (tuple(oracle for oracle in ORACLES if oracle not in FAULTS), ("own", *FAULTS))
"""Oracles of which each holds what is true in those before it."""
