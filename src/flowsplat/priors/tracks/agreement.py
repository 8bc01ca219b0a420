"""Estimate how the neighbors of a point move: the affine motion that most of them agree on."""

from __future__ import annotations

import numpy as np
from numba import float32
from scipy.spatial import cKDTree

from flowsplat.common.kernels import kernel
from flowsplat.common.threads import parallel_for

NEIGHBOR_TRACKS = 12
"""Nearest tracks whose motion a track is compared with. Chosen by eye."""
MIN_NEIGHBORS = 4
"""Neighbors without which nothing is said. Chosen by eye."""
REWEIGHTINGS = 4
"""Rounds of reweighting of the neighbors' motion. Chosen by eye."""
NEIGHBOR_STIFFNESS = np.float32(0.05)
"""Weight against differences between neighbors, beside the sum of their own weights. Chosen by eye."""
MIN_SPREAD = np.float32(0.15)
"""Pixels. Chosen by eye."""


def compute_agreed_motion(
    points: np.ndarray, motions: np.ndarray, weights: np.ndarray, labels: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what the neighbors of every point, itself left out, say about its motion.

    A weighted affine fit to the nearest ones, reweighted by Cauchy's function of what remains; it starts at their median.

    Args:
        points: [N, 2] pixels.
        motions: [N, 2] pixels to where each point has moved.
        weights: [N] how far each is believed; 0 = not at all.
        labels: [N] only points of the same label are neighbors.
        reach: pixels within which neighbors are.

    Returns:
        motion [N, 2], its gradient [N, 2, 2], and its spread [N]: the median of what remains, in pixels; infinite where
        there are too few neighbors.
    """
    motion, gradient = np.zeros((len(points), 2), np.float32), np.zeros((len(points), 2, 2), np.float32)
    spread = np.full(len(points), np.inf, np.float32)
    arrays = [np.ascontiguousarray(array, np.float32) for array in (points, motions, weights)]
    for label in np.unique(labels):
        here = np.flatnonzero(labels == label)
        sources = here[weights[here] > 0]
        if len(sources) < MIN_NEIGHBORS:
            continue
        # One more than needed: a source finds itself first.
        count = min(NEIGHBOR_TRACKS + 1, len(sources))
        _, found = cKDTree(points[sources]).query(points[here], k=count, distance_upper_bound=reach)
        index = np.append(sources, -1)[found.reshape(len(here), count)]
        parallel_for(_fit, len(here), here, index, *arrays, float32(reach), motion, gradient, spread)
    return motion, gradient, spread


@kernel
def _fit(begin, end, here, index, points, motions, weights, reach, motion, gradient, spread):
    one = float32(1)
    for row in range(begin, end):
        n = here[row]
        count = 0
        chosen = np.empty(index.shape[1], np.int64)
        for k in range(index.shape[1]):
            if index[row, k] >= 0 and index[row, k] != n:
                chosen[count] = index[row, k]
                count += 1
        if count < MIN_NEIGHBORS:
            continue
        H, b = np.empty((3, 3), np.float32), np.empty((3, 2), np.float32)
        rest, factor = np.zeros(count, np.float32), np.ones(count, np.float32)
        median_x, median_y = float32(np.median(motions[chosen[:count], 0])), float32(np.median(motions[chosen[:count], 1]))
        for k in range(count):
            m = chosen[k]
            rest[k] = np.sqrt((motions[m, 0] - median_x) ** 2 + (motions[m, 1] - median_y) ** 2)
        scale = max(float32(np.median(rest)), MIN_SPREAD)
        for k in range(count):
            factor[k] = one / (one + (rest[k] / (float32(1.5) * scale)) ** 2)
        for _ in range(REWEIGHTINGS):
            H[:], b[:] = float32(0), float32(0)
            H[0, 0], H[1, 1], H[2, 2] = float32(1e-6), NEIGHBOR_STIFFNESS, NEIGHBOR_STIFFNESS
            for k in range(count):
                m = chosen[k]
                w = weights[m] * factor[k]
                x, y = (points[m, 0] - points[n, 0]) / reach, (points[m, 1] - points[n, 1]) / reach
                H[0, 0] += w
                H[0, 1] += w * x
                H[0, 2] += w * y
                H[1, 1] += w * x * x
                H[1, 2] += w * x * y
                H[2, 2] += w * y * y
                for c in range(2):
                    b[0, c] += w * motions[m, c]
                    b[1, c] += w * x * motions[m, c]
                    b[2, c] += w * y * motions[m, c]
            H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
            for i in range(3):
                for j in range(i + 1, 3):
                    f = H[j, i] / H[i, i]
                    H[j] -= f * H[i]
                    b[j] -= f * b[i]
            for i in range(2, -1, -1):
                for j in range(i + 1, 3):
                    b[i] -= H[i, j] * b[j]
                b[i] /= H[i, i]
            for k in range(count):
                m = chosen[k]
                x, y = (points[m, 0] - points[n, 0]) / reach, (points[m, 1] - points[n, 1]) / reach
                dx = motions[m, 0] - b[0, 0] - x * b[1, 0] - y * b[2, 0]
                dy = motions[m, 1] - b[0, 1] - x * b[1, 1] - y * b[2, 1]
                rest[k] = np.sqrt(dx * dx + dy * dy)
            scale = max(float32(np.median(rest)), MIN_SPREAD)
            for k in range(count):
                factor[k] = one / (one + (rest[k] / (float32(1.5) * scale)) ** 2)
        motion[n] = b[0]
        for c in range(2):
            gradient[n, c, 0], gradient[n, c, 1] = b[1, c] / reach, b[2, c] / reach
        spread[n] = scale
