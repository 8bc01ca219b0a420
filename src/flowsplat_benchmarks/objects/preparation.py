"""The scenes of one random world: with priors of our own, and with the true ones as far as the step under test allows.

Everything before that step stays in the folder of the world, so that only the step itself runs again after it changed:

    own/   images, truth, and cameras, flow, masks, tracks and solved matches from the images alone; depth
    true/  the same with true cameras, flow and masks
"""

from __future__ import annotations

import os
import shutil
from itertools import pairwise
from pathlib import Path
from typing import Literal

from flowsplat.common.errors import InputError
from flowsplat.priors.cameras import CameraOptions, camera_stage
from flowsplat.priors.depth import depth_stage
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.masks import mask_stage
from flowsplat.priors.objects import objects_stage
from flowsplat.priors.tracks import tracks_stage
from flowsplat.scenes import Scene
from flowsplat_benchmarks.worlds import draw_world, write_world
from flowsplat_benchmarks.worlds.writing import OBJECTS

WorldKind = Literal["any", "dancers", "crowd"]
"""Which worlds of ``draw_world``."""

Variant = Literal["own", "true"]
VARIANTS: tuple[Variant, ...] = ("own", "true")

FOUND = "masks_found"
"""Folder of a scene with the masks before the step under test."""

LINKED = ("frames", "truth")
"""Folders that both scenes have in common."""


def prepare_world(seed: int, folder: Path, width: int, height: int, frames: int, kind: WorldKind = "any") -> None:
    """Render a world and complete all that comes before the step under test, in both scenes.

    Raises:
        InputError: there is no such world, the folder cannot be written or holds a world of another size, or no cameras can be
            found.
    """
    own, true = (folder / variant for variant in VARIANTS)
    if not (own / "truth" / OBJECTS).exists():
        shutil.rmtree(folder, ignore_errors=True)
        write_world(own, draw_world(seed, width, height, frames, dancers=kind == "dancers", crowd=kind == "crowd"))
    scene = Scene(own)
    if (scene.width, scene.height, scene.num_frames) != (width, height, frames):
        raise InputError(f"{folder} holds a world of {scene.num_frames} frames of {scene.width}x{scene.height}: choose another -o.")
    if not true.exists():
        _share(own, true)
    _take_truth(Scene(true))
    stages = {"cameras": lambda: camera_stage(scene, CameraOptions()), "flow": lambda: flow_stage(scene)}
    stages["masks"] = lambda: mask_stage(scene)
    for name, stage in stages.items():
        if scene.prior(name) is None:
            stage()
    for each in (scene, Scene(true)):
        if each.prior("tracks") is None:
            tracks_stage(each)


def place_objects(scene: Scene, again: bool = False) -> None:
    """The step under test: depth trajectory, shape offset and distance of what moves, before a static world whose matches are
    solved already.

    Args:
        again: forget the depth that is there.
    """
    if again:
        scene.forget_priors(["depth"])
    # The step gives objects other numbers: it always begins with those that the mask stage gave.
    found, masks = scene.folder / FOUND, scene.folder / "masks"
    if not found.exists():
        partial = found.with_name(f".{FOUND}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(masks, partial)
        partial.rename(found)
    if scene.prior("depth") is None:
        shutil.copytree(found, masks, dirs_exist_ok=True)
        shutil.rmtree(scene.folder / "depth", ignore_errors=True)
        objects_stage(scene)
        depth_stage(scene)


def _share(own: Path, true: Path) -> None:
    """A second scene of the same images and truth, which are linked where the system can."""
    partial = true.with_name(".true.partial")
    shutil.rmtree(partial, ignore_errors=True)
    for name in LINKED:
        shutil.copytree(own / name, partial / name, copy_function=_link)
    info = Scene(own).info
    Scene.create(
        partial, name=info.name, source=info.source, width=info.width, height=info.height,
        timestamps=info.timestamps, holdout=None, source_fps=info.source_fps,
    )  # fmt: skip
    os.replace(partial, true)


def _link(source: str, target: str) -> None:
    """Files are never changed in place, so that a link is as good as a copy."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _take_truth(scene: Scene) -> None:
    """Cameras, flow and masks of the truth."""
    truth = scene.truth
    assert truth is not None
    if scene.prior("cameras") is None:
        scene.write_cameras(truth.cameras)
        scene.finish_prior("cameras", method="truth", verdict="true cameras")
    if scene.prior("flow") is None:
        for i, j in pairwise(scene.train_frames):
            scene.write_flow(truth.flow(i, j))
            scene.write_flow(truth.flow(j, i))
        scene.finish_prior("flow", method="truth", verdict="true flow")
    if scene.prior("masks") is None:
        for i in scene.train_frames:
            scene.write_mask(i, truth.mask(i))
        scene.finish_prior("masks", method="truth", verdict="true masks")
