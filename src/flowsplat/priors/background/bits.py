"""Images with a pixel in four bytes, which kernels fetch at once (``common.simd.gather``) and take apart (``byte_of``)."""

from __future__ import annotations

import numpy as np


def pack(images: np.ndarray, marked: np.ndarray) -> np.ndarray:
    """Red, green, blue [J, H, W, 3] uint8 and a mark [J, H, W] bool, from the lowest byte on, as the bits of float32 [J, H, W]."""
    bytes_of = np.empty((*marked.shape, 4), np.uint8)
    bytes_of[..., :3], bytes_of[..., 3] = images, marked
    words: np.ndarray = bytes_of.view("<u4")[..., 0].astype(np.uint32, copy=False).view(np.float32)
    return words
