"""Depth of the still scene that frames agree on: what each sees of a surface is carried to the others, and they vote.

Averages across a jump of depth are on neither surface; a vote is on one of them. Errors of flow near edges are of one sign (near
surfaces swell), so of two surfaces with about as many votes the farther is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowsplat.common.kernels import kernel
from flowsplat.common.simd import LANES, broadcast, load, magnitude, maximum, store, where_above, where_at_least
from flowsplat.common.threads import parallel_for
from flowsplat.geometry import Camera
from flowsplat.priors.background.reprojection import reproject

SURFACE_TOLERANCE = 0.02
"""Share of the inverse depth by which two values of one surface differ at most (docs/method/depth.md)."""
FARTHER_VOTE_SHARE = 0.8
"""Share of the most votes that is enough for a surface that lies farther back (docs/method/depth.md)."""
OWN_VOTES = 1.5
"""Votes of the frame itself, a little more than that of any other. Chosen by eye."""


def vote_on_depth(
    inverse: np.ndarray, still: np.ndarray, camera: Camera, others: Sequence[tuple[np.ndarray, np.ndarray, Camera]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return what most frames say of the inverse depth of each pixel.

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
        values.append(reproject(other, asked.astype(np.float32), there, camera)[0])
    stacked, voted, share = np.stack(values), np.empty(inverse.shape, np.float32), np.empty(inverse.shape, np.float32)
    parallel_for(_vote, len(inverse), stacked, voted, share)
    return np.where(still, voted, inverse), np.where(still, share, np.float32(1))


@kernel
def _vote(begin: int, end: int, values: np.ndarray, chosen: np.ndarray, share: np.ndarray) -> None:
    count, _, width = values.shape
    same, enough, nothing, one = np.float32(SURFACE_TOLERANCE), np.float32(FARTHER_VOTE_SHARE), np.float32(0), np.float32(1)
    weights = np.empty(count, np.float32)
    for a in range(count):
        weights[a] = OWN_VOTES if a == 0 else one
    room = max(width, LANES)
    for y in range(begin, end):
        row, votes = np.empty(count * room, np.float32), np.empty(count * LANES, np.float32)
        for a in range(count):
            for x in range(room):
                row[a * room + x] = values[a, y, x] if x < width else nothing
        found, agree = np.empty(room, np.float32), np.empty(room, np.float32)
        for block in range(0, room, LANES):
            x = min(block, room - LANES)  # The last block overlaps the one before.
            most, said = broadcast(nothing), broadcast(nothing)
            for a in range(count):
                value, total = load(row, a * room + x), broadcast(nothing)
                for b in range(count):
                    apart = magnitude(load(row, b * room + x) - value)
                    total = total + where_at_least(same * value, apart, broadcast(weights[b]), broadcast(nothing))
                total = where_above(value, nothing, total, broadcast(nothing))
                said = said + where_above(value, nothing, broadcast(weights[a]), broadcast(nothing))
                store(votes, a * LANES, total)
                most = maximum(most, total)
            limit, best, value = enough * most, load(votes, 0), load(row, x)
            for a in range(1, count):
                total, other = load(votes, a * LANES), load(row, a * room + x)
                better = where_at_least(best, limit, where_above(value, other, broadcast(one), broadcast(nothing)), broadcast(one))
                better = where_at_least(total, limit, better, broadcast(nothing))
                best, value = where_above(better, nothing, total, best), where_above(better, nothing, other, value)
            total, sum_of = broadcast(nothing), broadcast(nothing)
            for a in range(count):
                other = load(row, a * room + x)
                apart = magnitude(other - value)
                weight = where_at_least(same * value, apart, broadcast(weights[a]), broadcast(nothing))
                total, sum_of = total + weight, sum_of + weight * other
            store(found, x, sum_of / total)
            store(agree, x, best / said)
        for x in range(width):
            chosen[y, x], share[y, x] = found[x], agree[x]
