"""Depth maps seen from other cameras: what one frame knows of the static scene, at the pixels of another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowsplat.common.kernels import kernel
from flowsplat.geometry import Camera


def uncover(
    hidden: np.ndarray,
    inverse_depth: np.ndarray,
    weight: np.ndarray,
    camera: Camera,
    others: Sequence[tuple[np.ndarray, np.ndarray, Camera]],
) -> tuple[np.ndarray, np.ndarray]:
    """Static inverse depth and its weight, each [h, w] float32, with ``hidden`` pixels that other frames know put in.

    Args:
        hidden: bool [h, w], objects and what is too close to them, and pixels that the frame itself is not sure of.
        inverse_depth: [h, w] of the frame itself, with its weight and camera.
        others: inverse depth, weight (0 on objects) and camera of other frames.
    """
    found, found_weight = np.zeros_like(inverse_depth), np.zeros_like(weight)
    for other in others:
        _carry(*other, camera, found, found_weight)
    better = hidden & (found_weight > weight)
    return np.where(better, found, inverse_depth), np.where(better, found_weight, weight)


def reproject(inverse_depth: np.ndarray, weight: np.ndarray, camera: Camera, to: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth and weight, each [h, w], as another camera sees them, 0 where it sees none; the nearest point wins."""
    found, found_weight = np.zeros_like(inverse_depth), np.zeros_like(weight)
    _carry(inverse_depth, weight, camera, to, found, found_weight)
    return found, found_weight


def _carry(
    inverse_depth: np.ndarray, weight: np.ndarray, camera: Camera, to: Camera, out: np.ndarray, out_weight: np.ndarray
) -> None:
    _splat(inverse_depth, weight, np.array([camera.intrinsics, to.intrinsics]), to.pose_from(camera), out, out_weight)


@kernel
def _splat(
    inverse: np.ndarray, weight: np.ndarray, intrinsics: np.ndarray, pose: np.ndarray, out: np.ndarray, out_weight: np.ndarray
) -> None:
    """Carry every known pixel to another camera; the nearest point wins a pixel."""
    h, w = inverse.shape
    K, L = intrinsics[0], intrinsics[1]
    for y in range(h):
        for x in range(w):
            if weight[y, x] <= 0:
                continue
            z = 1.0 / inverse[y, x]
            px, py = (x + 0.5 - K[2]) / K[0] * z, (y + 0.5 - K[3]) / K[1] * z
            qz = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * z + pose[2, 3]
            if qz <= 1e-3 * z:
                continue
            c = int(np.floor(L[0] * (pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * z + pose[0, 3]) / qz + L[2]))
            r = int(np.floor(L[1] * (pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * z + pose[1, 3]) / qz + L[3]))
            if 0 <= c < w and 0 <= r < h and 1.0 / qz > out[r, c]:
                out[r, c] = 1.0 / qz
                out_weight[r, c] = weight[y, x]
