"""Depth of the still scene that frames agree on: what each sees of a surface is carried to the others, and they vote.

Averages across a jump of depth are on neither surface; a vote is on one of them. Errors of flow near edges are of one sign (near
surfaces swell), so of two surfaces with about as many votes the farther is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import prange

from flowsplat.common.kernels import parallel_kernel
from flowsplat.geometry import Camera
from flowsplat.priors.background.reprojection import carried

SAME = 0.02
"""Share of the inverse depth by which two values of one surface differ at most."""
ENOUGH = 0.8
"""Share of the most votes that is enough for a surface that lies farther back."""
OWN = 1.5
"""Votes of the frame itself, a little more than that of any other."""


def agreed(
    inverse: np.ndarray, still: np.ndarray, camera: Camera, others: Sequence[tuple[np.ndarray, np.ndarray, Camera]]
) -> tuple[np.ndarray, np.ndarray]:
    """What most frames say of the inverse depth of each pixel.

    Args:
        inverse: [H, W] float32 of the frame itself, positive.
        still: [H, W] bool, pixels that may change.
        camera: of the frame.
        others: inverse depth [H, W] of other frames, where these may be asked [H, W] bool, and their cameras.

    Returns:
        inverse depth [H, W] float32, the mean of those that agree, and how many of those that say anything do [H, W] float32,
        0 to 1; 1 where none was asked.
    """
    values = [inverse]
    for other, asked, there in others:
        values.append(carried(other, asked.astype(np.float32), there, camera)[0])
    voted, share = _vote(np.stack(values))
    return np.where(still, voted, inverse), np.where(still, share, np.float32(1))


@parallel_kernel
def _vote(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    count, height, width = values.shape
    chosen, share = values[0].copy(), np.ones((height, width), np.float32)
    same, enough, own = np.float32(SAME), np.float32(ENOUGH), np.float32(OWN)
    for y in prange(height):
        votes = np.empty(count, np.float32)
        for x in range(width):
            most, said = np.float32(0), np.float32(0)
            for a in range(count):
                value = values[a, y, x]
                votes[a] = np.float32(0)
                if value > 0:
                    said += own if a == 0 else np.float32(1)
                    for b in range(count):
                        if abs(values[b, y, x] - value) <= same * value:
                            votes[a] += own if b == 0 else np.float32(1)
                most = max(most, votes[a])
            best = 0
            for a in range(count):
                if votes[a] >= enough * most and (votes[best] < enough * most or values[a, y, x] < values[best, y, x]):
                    best = a
            value, total, sum_of = values[best, y, x], np.float32(0), np.float32(0)
            for a in range(count):
                if abs(values[a, y, x] - value) <= same * value:
                    weight = own if a == 0 else np.float32(1)
                    total += weight
                    sum_of += weight * values[a, y, x]
            chosen[y, x] = sum_of / total
            share[y, x] = votes[best] / said
    return chosen, share
