"""Tell objects from small parts: shreds of masks that nothing joined to what they belong to."""

from __future__ import annotations

import numpy as np

from flowsplat.scenes import Scene

SMALL_PART_SHARE = 0.05
"""Of the pixels of the largest object in all training frames, the share below which one is a small part. Chosen by eye."""


def large_objects(scene: Scene) -> set[int]:
    """Return the numbers in the masks of what is no small part."""
    areas = np.zeros(256, np.int64)
    for i in scene.train_frames:
        areas += np.bincount(scene.mask(i).ravel(), minlength=256)
    areas[0] = 0
    return {int(number) for number in np.flatnonzero((areas > 0) & (areas >= SMALL_PART_SHARE * areas.max()))}


def describe_count(count: int, small: int = 0) -> str:
    """``"nothing moves"``, ``"1 moving object"``, ``"2 moving objects and 1 small part"``."""
    if not count:
        return "nothing moves"
    parts = f" and {small} small part{'s' * (small > 1)}" if small else ""
    return f"{count} moving object{'s' * (count > 1)}{parts}"
