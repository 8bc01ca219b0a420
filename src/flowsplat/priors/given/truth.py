"""The truth of a rendered scene."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.interpolation import sample_map
from flowsplat.scenes import Flow, Scene
from flowsplat.scenes.layers import Layers

MAX_FLOW_STEP = 0.5
"""Pixels by which flow may differ between neighbors: more is the edge of something, and what lies between them is none of both.
Chosen by eye."""


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


def true_flow(truth: Layers, i: int, j: int) -> Flow | None:
    """Return the true flow between two frames; None where the truth lacks it.

    Across held-out frames it is put together from the true flow of the pairs between. It is trusted where each of these is; what
    is hidden on the way, or comes to lie at the edge of something, is not, whether it is seen in both frames or not.
    """
    known = set(truth.flow_pairs)
    if (i, j) in known:
        return truth.flow(i, j)
    frames = list(range(i, j + 1)) if i < j else list(range(i, j - 1, -1))
    if not known.issuperset(pairwise(frames)):
        return None
    first = truth.flow(*frames[:2])
    flow, trusted = first.flow, first.trusted
    for pair in pairwise(frames[1:]):
        flow, trusted = _extend(flow, trusted, truth.flow(*pair))
    return Flow(i, j, flow, trusted.astype(np.float32))


def _extend(flow: np.ndarray, trusted: np.ndarray, further: Flow) -> tuple[np.ndarray, np.ndarray]:
    """Return flow [H, W, 2] that goes on by another one, and where it is trusted: where all four pixels around are, and alike."""
    height, width = trusted.shape
    target = pixel_grid(width, height) + flow
    inside = ((target >= 0.5) & (target <= [width - 0.5, height - 0.5])).all(-1)
    around = np.stack([further.flow[y : height - 1 + y, x : width - 1 + x] for y in (0, 1) for x in (0, 1)])
    alike = (np.ptp(around, axis=0) <= MAX_FLOW_STEP).all(-1)
    for y in (0, 1):
        for x in (0, 1):
            alike &= further.trusted[y : height - 1 + y, x : width - 1 + x]
    column, row = np.moveaxis(np.floor(np.where(inside[..., None], target, 1.0) - 0.5).astype(np.int64), -1, 0)
    sure = alike[row.clip(0, height - 2), column.clip(0, width - 2)]
    return flow + sample_map(further.flow, target.reshape(-1, 2)).reshape(flow.shape), trusted & inside & sure
