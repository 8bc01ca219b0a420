"""Cameras and times as numbers in a buffer, as the Triton kernels of culling, slicing and flow read them.

A *camera* is ``CAMERA`` numbers: the view matrix [4, 4] by rows, then from ``INTRINSICS`` on K [3, 3] by rows. A *moment* is
``count_moment_numbers`` numbers: the time, another time, the camera's center, and cosines for the brightness in time.
"""

from __future__ import annotations

import numpy as np
import triton
import triton.language as tl
from torch import Tensor

from flowsplat.geometry import Camera

# Of a camera.
VIEW_ROW = tl.constexpr(4)  # numbers of a row of the view matrix
INTRINSICS = tl.constexpr(16)
FX, CX, FY, CY = (tl.constexpr(INTRINSICS.value + place) for place in (0, 2, 4, 5))
CAMERA = tl.constexpr(16 + 9)

# Of a moment.
TIME, NEXT_TIME, CENTER, COSINES = tl.constexpr(0), tl.constexpr(1), tl.constexpr(2), tl.constexpr(5)


def camera_numbers(*cameras: Camera) -> np.ndarray:
    """[cameras, ``CAMERA``] float32."""
    return np.array([[*camera.viewmat.ravel(), *camera.K.ravel()] for camera in cameras], np.float32)


def camera_tensors(numbers: Tensor) -> tuple[Tensor, Tensor]:
    """View matrix [4, 4] and K [3, 3] of the numbers [``CAMERA``] of one camera, in the same memory."""
    return numbers[: INTRINSICS.value].view(4, 4), numbers[INTRINSICS.value :].view(3, 3)


def count_moment_numbers(gains: int) -> int:
    """How many numbers a moment has, of a model with so many gains."""
    return COSINES.value + gains


def pack_moment(gains: int, t: float, camera_center: np.ndarray, next_time: float | None) -> np.ndarray:
    """[``count_moment_numbers``] float32."""
    cosines = np.cos(np.pi * t * np.arange(1, gains + 1))
    return np.concatenate([[t, next_time or 0.0], camera_center, cosines]).astype(np.float32)


@triton.jit
def to_camera(camera, x, y, z):
    """A point in camera axes."""
    right = tl.load(camera) * x + tl.load(camera + 1) * y + tl.load(camera + 2) * z + tl.load(camera + 3)
    down = tl.load(camera + 4) * x + tl.load(camera + 5) * y + tl.load(camera + 6) * z + tl.load(camera + 7)
    depth = tl.load(camera + 8) * x + tl.load(camera + 9) * y + tl.load(camera + 10) * z + tl.load(camera + 11)
    return right, down, depth


@triton.jit
def to_world(camera, right, down, depth):
    """A gradient from camera axes to world axes."""
    x = tl.load(camera) * right + tl.load(camera + 4) * down + tl.load(camera + 8) * depth
    y = tl.load(camera + 1) * right + tl.load(camera + 5) * down + tl.load(camera + 9) * depth
    z = tl.load(camera + 2) * right + tl.load(camera + 6) * down + tl.load(camera + 10) * depth
    return x, y, z


@triton.jit
def view_row(camera, row: tl.constexpr):
    """Three numbers of the rotation: a row of the view matrix."""
    at = camera + VIEW_ROW * row
    return tl.load(at), tl.load(at + 1), tl.load(at + 2)
