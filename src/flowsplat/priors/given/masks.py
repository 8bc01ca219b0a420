"""Masks from a folder of images: our own numbering, DAVIS's Annotations, or any names in the order of the frames."""

from __future__ import annotations

from pathlib import Path

from flowsplat.priors.given.fitting import files_by_frame, require_shape
from flowsplat.scenes import Scene
from flowsplat.scenes.formats.masks import GivenMasks, read_labels, require_rest

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


def use_masks(folder: Path, scene: Scene) -> None:
    """Write the masks of the training frames into the scene, and those of held-out frames for the evaluation.

    Raises:
        InputError: one of a training frame is missing, damaged, or of another shape; or hardly anything rests by them.
    """
    paths = files_by_frame(Path(folder), SUFFIXES, scene, "a mask")
    first = paths[scene.train_frames[0]]
    height, width = read_labels(first).shape
    require_shape(first, width, height, scene)
    training = GivenMasks.scan({str(i): paths[i] for i in scene.train_frames}, (width, height))
    size = (scene.width, scene.height)
    masks = {i: training.read(str(i), size) for i in scene.train_frames}
    require_rest(str(folder), list(masks.values()))
    for i, mask in masks.items():
        scene.write_mask(i, mask)
    for i in scene.heldout_frames:
        if i in paths:
            scene.heldout_masks.write_mask(i, training.read_moving(paths[i], size))
