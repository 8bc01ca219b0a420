"""Object numbers that follow the parts of masks over time."""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.geometry.cameras import pixel_grid
from flowsplat.priors.continuity import Continuity
from flowsplat.scenes import Scene

MAX_FRAGMENT_SHARE = 0.2
"""Share of an object's largest part up to which another part still belongs to it. Chosen by eye."""


MIN_OWNED_SHARE = 0.15
"""Share of a part that an object must hold to own it, with most of its own pixels in it. Chosen by eye."""


def number_objects(scene: Scene) -> tuple[int, float]:
    """Give the parts of the stored masks object numbers that follow them over time.

    A part takes the number of the object that is mostly in it, else the one that most of its pixels had one frame before,
    or a new one if most had none. Where objects touch and become one part, every pixel goes to the nearest of them. Of
    several parts with one number the largest keeps it, with its fragments; the others part ways.

    Returns:
        How many objects there are, and the share of all pixels they cover.
    """
    frames = scene.train_frames
    continuity = Continuity(scene)
    grid = pixel_grid(scene.width, scene.height)
    before = np.zeros((scene.height, scene.width), np.uint8)
    highest, pixels = 0, 0
    for index, i in enumerate(frames):
        moving = (scene.mask(i) > 0).astype(np.uint8)
        if index and not continuity.same_piece(index, index - 1):
            before = np.zeros_like(before)
        elif index and moving.any():
            came_from = np.floor(grid + scene.flow(i, frames[index - 1]).flow).astype(int)
            x, y = (np.clip(came_from[..., axis], 0, size - 1) for axis, size in ((0, scene.width), (1, scene.height)))
            before = before[y, x]
        count, labels, owners = _divide(moving, before)
        numbers = np.zeros(count, np.uint8)
        areas = np.bincount(labels.ravel(), minlength=count)
        taken: dict[int, int] = {}
        for part in sorted(range(1, count), key=lambda part: (part not in owners, -areas[part])):
            number = owners.get(part, int(np.bincount(before[labels == part], minlength=1).argmax()))
            if number == 0 or areas[part] > MAX_FRAGMENT_SHARE * taken.get(number, areas[part] / MAX_FRAGMENT_SHARE):
                highest = min(highest + 1, 255)
                number = highest
            taken.setdefault(number, int(areas[part]))
            numbers[part] = number
        before = np.asarray(numbers[labels])
        scene.write_mask(i, before)
        pixels += int((before > 0).sum())
    return highest, pixels / (len(frames) * scene.width * scene.height)


def _divide(moving: np.ndarray, before: np.ndarray) -> tuple[int, np.ndarray, dict[int, int]]:
    """Return the parts of a mask, those of several objects divided.

    Args:
        moving: [H, W] uint8 of 0 and 1.
        before: [H, W] uint8, the numbers that its pixels had one frame before.

    Returns:
        One more than how many parts there are, their labels [H, W] from 1, and the object that owns a label.
    """
    count, labels = cv2.connectedComponents(moving)
    all_held = np.bincount(before[moving > 0], minlength=256)
    owners: dict[int, int] = {}
    for part in range(1, count):
        inside = labels == part
        held = np.bincount(before[inside], minlength=256)
        held[0] = 0
        own = np.flatnonzero((held > MIN_OWNED_SHARE * inside.sum()) & (2 * held > all_held))
        if len(own) > 1:
            away = [cv2.distanceTransform((~(inside & (before == n))).astype(np.uint8), cv2.DIST_L2, 3) for n in own]
            nearest = np.argmin(away, axis=0)
        for index, number in enumerate(own):
            label = part if index == 0 else count
            if index > 0:
                labels[inside & (nearest == index)] = label
                count += 1
            owners[label] = int(number)
    return count, labels, owners
