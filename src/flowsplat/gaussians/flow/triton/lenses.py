"""What kernels know of a camera: 25 numbers, the view matrix and from ``K`` on the intrinsics, both by rows."""

from __future__ import annotations

import numpy as np
import triton
import triton.language as tl

from flowsplat.geometry import Camera

K = tl.constexpr(16)


def lens_numbers(*cameras: Camera) -> np.ndarray:
    """[cameras, 25] float32."""
    return np.array([[*camera.viewmat.ravel(), *camera.K.ravel()] for camera in cameras], np.float32)


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


@triton.jit
def to_camera(lens, x, y, z):
    """A point in camera axes."""
    right = tl.load(lens) * x + tl.load(lens + 1) * y + tl.load(lens + 2) * z + tl.load(lens + 3)
    down = tl.load(lens + 4) * x + tl.load(lens + 5) * y + tl.load(lens + 6) * z + tl.load(lens + 7)
    depth = tl.load(lens + 8) * x + tl.load(lens + 9) * y + tl.load(lens + 10) * z + tl.load(lens + 11)
    return right, down, depth


@triton.jit
def to_world(lens, right, down, depth):
    """A gradient from camera axes to world axes."""
    x = tl.load(lens) * right + tl.load(lens + 4) * down + tl.load(lens + 8) * depth
    y = tl.load(lens + 1) * right + tl.load(lens + 5) * down + tl.load(lens + 9) * depth
    z = tl.load(lens + 2) * right + tl.load(lens + 6) * down + tl.load(lens + 10) * depth
    return x, y, z
