"""Masks of a prepared scene with one fault after the other taken off, by the truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from flowsplat.scenes import Scene
from flowsplat_benchmarks.oracles.objects import MIN_PIXELS, masks_of, match_objects, truth_of

FAULTS = {
    "ids": "true ids of our masks",
    "shadow": "our masks without what rests",
    "parts": "whole objects where our masks found them",
    "masks": "true masks",
}
"""What is true of the masks once a fault and those before it are taken off."""


def mend_masks(scene: Scene, fault: str) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (training frame, mask [H, W] uint8) of a scene, without a fault of ``FAULTS`` and those before it.

    Objects have their true numbers. Where no fault of shadows is taken off, what is on nothing that moves keeps to the object that
    it hangs together with.

    Raises:
        InputError: the scene has no truth.
    """
    objects, highest = match_objects(scene), max(int(truth_of(scene).mask(i).max()) for i in scene.train_frames)
    owner = {number: obj.true for obj in objects for number in obj.ids if obj.true}
    alone = [number for obj in objects for number in obj.ids if not obj.true]
    owner |= {number: min(highest + 1 + k, 255) for k, number in enumerate(alone)}
    for i, mask, true in masks_of(scene):
        yield i, _mend(mask, true, fault, owner)


def _mend(mask: np.ndarray, true: np.ndarray, fault: str, owner: Mapping[int, int]) -> np.ndarray:
    if fault == "masks":
        return true
    if fault == "ids":
        return correct_ids(mask, true, owner)
    moves = np.where(mask > 0, true, 0).astype(np.uint8)
    if fault == "shadow":
        return moves
    found = np.flatnonzero(np.bincount(moves.ravel()) >= MIN_PIXELS)
    return np.where(np.isin(true, found[found > 0]), true, moves).astype(np.uint8)


def correct_ids(mask: np.ndarray, true: np.ndarray, owner: Mapping[int, int]) -> np.ndarray:
    """Return a mask [H, W] uint8 of the same pixels, with true ids.

    A pixel that is truly on nothing that moves has the id of the nearest one that is, in the same connected part of the mask; in a
    part without any, that of its own object.

    Args:
        mask: [H, W] uint8 our numbers, true: [H, W] uint8 the true ones.
        owner: true ids of our numbers.
    """
    table = np.arange(256, dtype=np.uint8)
    table[list(owner)] = list(owner.values())
    inside = mask > 0
    result = np.where(inside, np.where(true > 0, true, table[mask]), 0).astype(np.uint8)
    count, parts, boxes, _ = cv2.connectedComponentsWithStats(inside.astype(np.uint8))
    for part in range(1, count):
        x, y, width, height = boxes[part, :4]
        window = slice(y, y + height), slice(x, x + width)
        here = parts[window] == part
        known = here & (true[window] > 0)
        if known.any() and (here & ~known).any():
            rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)
            result[window][here] = true[window][rows, columns][here]
    return result
