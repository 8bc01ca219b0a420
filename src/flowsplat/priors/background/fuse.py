"""Depth maps of neighboring frames that agree make each other better; what no neighbor confirms loses its weight."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowsplat.common.kernels import kernel
from flowsplat.common.threads import parallel_for
from flowsplat.geometry import Camera

AGREEMENT_DISTANCE = 1.5
"""Working pixels: a neighbor agrees if its point lands this close to where the pixel's own point lands. Chosen by eye."""


def fuse(
    inverse_depth: np.ndarray,
    weight: np.ndarray,
    camera: Camera,
    neighbors: Sequence[tuple[np.ndarray, np.ndarray, Camera]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average a frame's inverse depth with that of its neighbors where they see the same point.

    Args:
        inverse_depth: [h, w] float32, positive where ``weight`` is.
        weight: [h, w] float32, 0 = unknown.
        camera: of the frame, at the size of the arrays.
        neighbors: inverse depth, weight and camera of each other frame.

    Returns:
        Inverse depth, weight (summed over those that agree), and how many neighbors agree less how many disagree,
        each [h, w] float32.
    """
    inverses = np.stack([inverse_depth, *(n[0] for n in neighbors)]).astype(np.float32)
    weights = np.stack([weight, *(n[1] for n in neighbors)]).astype(np.float32)
    cameras = [camera, *(n[2] for n in neighbors)]
    intrinsics = np.array([c.intrinsics for c in cameras])
    there = np.array([c.pose_from(camera) for c in cameras])
    back = np.array([camera.pose_from(c) for c in cameras])
    fused, mass, votes = inverses[0].copy(), weights[0].copy(), np.zeros_like(inverses[0])
    parallel_for(_fuse, len(fused), inverses, weights, intrinsics, there, back, fused, mass, votes)
    return fused, mass, votes


@kernel
def _fuse(
    begin: int, end: int, inverses: np.ndarray, weights: np.ndarray, intrinsics: np.ndarray, there: np.ndarray, back: np.ndarray,
    fused: np.ndarray, mass: np.ndarray, votes: np.ndarray,
) -> None:  # fmt: skip
    count, h, w = inverses.shape
    K0 = intrinsics[0]
    for y in range(begin, end):
        for x in range(w):
            own = weights[0, y, x]
            if own <= 0:
                continue
            z = 1.0 / inverses[0, y, x]
            px, py = (x + 0.5 - K0[2]) / K0[0] * z, (y + 0.5 - K0[3]) / K0[1] * z
            total, sum_inverse, vote = float(own), own * inverses[0, y, x], 0.0
            for j in range(1, count):
                P, K = there[j], intrinsics[j]
                cz = P[2, 0] * px + P[2, 1] * py + P[2, 2] * z + P[2, 3]
                if cz <= 1e-6 * z:
                    continue
                u = K[0] * (P[0, 0] * px + P[0, 1] * py + P[0, 2] * z + P[0, 3]) / cz + K[2]
                v = K[1] * (P[1, 0] * px + P[1, 1] * py + P[1, 2] * z + P[1, 3]) / cz + K[3]
                c, r = int(np.floor(u)), int(np.floor(v))
                if c < 0 or r < 0 or c >= w or r >= h or weights[j, r, c] <= 0:
                    continue
                depth = 1.0 / inverses[j, r, c]
                qx, qy = (u - K[2]) / K[0] * depth, (v - K[3]) / K[1] * depth
                Q = back[j]
                bz = Q[2, 0] * qx + Q[2, 1] * qy + Q[2, 2] * depth + Q[2, 3]
                if bz <= 1e-6 * z:
                    continue
                bu = K0[0] * (Q[0, 0] * qx + Q[0, 1] * qy + Q[0, 2] * depth + Q[0, 3]) / bz + K0[2]
                bv = K0[1] * (Q[1, 0] * qx + Q[1, 1] * qy + Q[1, 2] * depth + Q[1, 3]) / bz + K0[3]
                off = (bu - x - 0.5) ** 2 + (bv - y - 0.5) ** 2
                ratio = z / bz
                if off < AGREEMENT_DISTANCE**2 and 0.8 < ratio < 1.25:
                    weight = weights[j, r, c] / (1.0 + off)
                    total += weight
                    sum_inverse += weight / bz
                    vote += 1.0
                else:
                    vote -= 1.0
            fused[y, x] = sum_inverse / total
            mass[y, x] = total
            votes[y, x] = vote
