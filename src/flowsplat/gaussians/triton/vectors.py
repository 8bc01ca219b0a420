"""Reading and writing rows of three numbers."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def load_vector(values, i, mask):
    """Three numbers of row i."""
    x = tl.load(values + i * 3, mask=mask, other=0.0)
    y = tl.load(values + i * 3 + 1, mask=mask, other=0.0)
    z = tl.load(values + i * 3 + 2, mask=mask, other=0.0)
    return x, y, z


@triton.jit
def store_vector(values, i, x, y, z, mask, STRIDE: tl.constexpr = 3):
    """Write three numbers of row i."""
    tl.store(values + i * STRIDE, x, mask=mask)
    tl.store(values + i * STRIDE + 1, y, mask=mask)
    tl.store(values + i * STRIDE + 2, z, mask=mask)
