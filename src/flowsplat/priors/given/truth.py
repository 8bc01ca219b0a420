"""The truth of a rendered scene."""

from __future__ import annotations

from itertools import pairwise

from flowsplat.common.errors import InputError
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import Layers


def consecutive_pairs(scene: Scene) -> list[tuple[int, int]]:
    """Return both directions between neighboring training frames."""
    return [pair for i, j in pairwise(scene.train_frames) for pair in ((i, j), (j, i))]


def true_layers(scene: Scene) -> Layers:
    """Return the truth of a rendered scene.

    Raises:
        InputError: the scene has no truth.
    """
    truth = scene.truth
    if truth is None or not truth.has_cameras:
        raise InputError(f"{scene.name} has no truth: only rendered scenes do. Use --priors own.")
    return truth
