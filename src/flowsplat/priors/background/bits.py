"""Pictures with a pixel in four bytes, which kernels fetch at once (``common.simd.gather``) and take apart (``byte_of``)."""

from __future__ import annotations

import numpy as np
from numba import njit

from flowsplat.common.kernels import OPTIONS


@njit(**OPTIONS)
def packed(pictures: np.ndarray, marked: np.ndarray) -> np.ndarray:
    """Red, green, blue [J, H, W, 3] uint8 and a mark [J, H, W] bool, from the lowest byte on, as the bits of float32 [J, H, W]."""
    J, H, W = marked.shape
    words = np.empty((J, H, W), np.uint32)
    for j in range(J):
        for y in range(H):
            for x in range(W):
                word = np.uint32(marked[j, y, x])
                for q in range(2, -1, -1):
                    word = word << np.uint32(8) | np.uint32(pictures[j, y, x, q])
                words[j, y, x] = word
    return words.view(np.float32)
