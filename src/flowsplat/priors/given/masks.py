"""Masks: a folder of images (our own numbering, DAVIS's Annotations, or any names in the order of the frames), those of ViPE, or
the JSON of Segment Anything Video."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.files import read_zip
from flowsplat.common.progress import report
from flowsplat.priors.given import sav, vipe
from flowsplat.priors.given.fitting import files_by_frame, require_shape
from flowsplat.priors.given.mask_gaps import fill_gaps
from flowsplat.scenes import Scene
from flowsplat.scenes.formats.masks import GRAY, GivenMasks, read_labels, require_rest, unpack_labels
from flowsplat.scenes.layers import decode_image_bytes

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_MAX_MASK_BYTES = 64 * 2**20
"""Of one mask in a zip. Chosen by eye."""


def use_masks(path: Path, scene: Scene) -> str:
    """Write the masks of the training frames into the scene, and those of held-out frames for the evaluation.

    Returns:
        a sentence about objects that had none for some frames and have one now; empty where there are none.

    Raises:
        InputError: one of a training frame is missing, damaged, or of another shape; or hardly anything rests by them.
    """
    paths, read = _find(Path(path), scene)
    first = paths[scene.train_frames[0]]
    height, width = read(first).shape
    require_shape(first, width, height, scene)
    training = GivenMasks.scan({str(i): paths[i] for i in scene.train_frames}, (width, height), read=read)
    size, lens = (scene.width, scene.height), scene.lens
    masks = {i: training.read(str(i), size) for i in scene.train_frames}
    require_rest(str(path), list(masks.values()))
    straight = masks if lens is None else {i: lens.straighten(mask) for i, mask in masks.items()}
    complete, filled = fill_gaps(straight, scene)
    for i, mask in complete.items():
        scene.write_mask(i, mask)
    for i in scene.heldout_frames:
        if i in paths:
            mask = training.read_moving(paths[i], size)
            scene.heldout_masks.write_mask(i, mask if lens is None else lens.straighten(mask))
    parts = [f"object {number} in {len(frames)} frame{'s' * (len(frames) > 1)}" for number, frames in filled.items()]
    told = f"lost and carried along the flow from before and after: {', '.join(parts)}" if parts else ""
    if told:
        report(f"Masks of {path}: {told}.")
    return told


def _find(path: Path, scene: Scene) -> tuple[dict[int, Path], Callable[[Path], np.ndarray]]:
    """Return the masks by their frames, and what reads the labels of one."""
    if archive := vipe.find_file(path, "mask", scene):
        resting = [label * GRAY for label in vipe.find_resting(archive)]

        def read(member: Path) -> np.ndarray:
            data = read_zip(archive, member.name, _MAX_MASK_BYTES)
            labels = unpack_labels(member, decode_image_bytes(member, data, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH))
            return np.where(np.isin(labels, resting), 0, labels)

        return {i: archive / name for i, name in vipe.list_members(archive, ".png", scene, "a mask").items()}, read
    if path.suffix.lower() == ".json":
        masklets = sav.read_masklets(path, scene)
        return {i: path / f"{i:05d}" for i in range(len(masklets))}, lambda part: sav.decode_labels(part, masklets[int(part.name)])
    return files_by_frame(path, SUFFIXES, scene, "a mask"), read_labels
