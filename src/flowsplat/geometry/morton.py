"""Order points so that neighbors follow each other, for files that are packed: a Morton curve."""

from __future__ import annotations

import numpy as np

CURVE_BITS = 10
"""Of each coordinate: there are so many cells along it as a power of two. Chosen by eye."""


def order_along_curve(points: np.ndarray) -> np.ndarray:
    """Return the numbers [N] of points [N, 3] in the order of a Morton curve through the ranks of their coordinates, which no
    outlier can stretch."""
    code = np.zeros(len(points), np.int64)
    for axis in range(3):
        ranks = np.empty(len(points), np.int64)
        ranks[np.argsort(points[:, axis], kind="stable")] = np.arange(len(points))
        cells = ranks * 2**CURVE_BITS // max(len(points), 1)
        for bit in range(CURVE_BITS):
            code |= ((cells >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")
