"""Inverse depth of every pixel from its matches in other frames with known cameras: Gauss-Newton, one pixel at a time.

A pixel with ray d at inverse depth w lies, up to scale, at A + w B in the axes of another camera, A = R d and B = t of
the relative pose. Each match proposes a w; the proposal that explains all matches best starts a robust Gauss-Newton.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowsplat.common.kernels import inline, kernel
from flowsplat.common.threads import parallel_for
from flowsplat.geometry import Camera
from flowsplat.priors.flow import lengths

ROBUST_SCALE = 0.5
"""Working pixels: a residual of this size has half its weight (Cauchy). Chosen by eye."""

DEPTH_ITERATIONS = 5
"""Gauss-Newton steps for every pixel. Chosen by eye."""

RIM_PARTS = 12
"""The outermost this many-th part of the image on each side is its rim. Chosen by eye."""

MIN_RIM_MATCHES = 50
"""Matches on the rim that are enough to judge by. Chosen by eye."""

MAX_RIM_NOISE_FACTOR = 2.0
"""Times the median error on the rim is the most that counts as noise. The median of all matches is below it in clips whose
objects fill less than half of the image. Chosen by eye."""


@dataclass(frozen=True)
class MultiView:
    """What the matches of one frame give for its pixels, each [h, w] float32 at working resolution.

    Attributes:
        inverse_depth: one over the planar depth; 0 where nothing is known.
        information: squared parallax in pixels that the matches have together: 1 / variance of the logarithm of the
            depth if matches are one pixel off.
        motion: how many times its noise level each match is off the rigid scene, on average (1 = as expected at rest).
    """

    inverse_depth: np.ndarray
    information: np.ndarray
    motion: np.ndarray


def solve_multiview(camera: Camera, others: Sequence[Camera], flows: np.ndarray, confidences: np.ndarray) -> MultiView:
    """Solve one frame.

    Args:
        camera: of the frame, at working resolution.
        others: the cameras [J] of the frames with matches.
        flows: [J, h, w, 2] float32, from the frame to each other one, in working pixels.
        confidences: [J, h, w] float32 of these matches; below one half a match is not used.
    """
    poses = np.array([other.pose_from(camera) for other in others], np.float64).reshape(-1, 3, 4)
    intrinsics = np.array([c.intrinsics for c in [camera, *others]])
    reach = float(np.linalg.norm(poses[:, :, 3], axis=1).max(initial=0.0))
    height, width = flows.shape[1:3]
    if reach < 1e-9:
        reach = 1.0  # No camera moved: every B is zero, and so is the information.
    poses[:, :, 3] /= reach
    # Along the last axis the matches of a pixel lie side by side.
    targets = np.ascontiguousarray(np.moveaxis(flows, 0, 2), dtype=np.float32)
    weights = np.ascontiguousarray(np.moveaxis(np.where(confidences >= 0.5, confidences, 0), 0, 2), dtype=np.float32)
    inverse_depth, information = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    errors = np.zeros(weights.shape, np.float32)
    parallel_for(
        _solve,
        height,
        intrinsics.astype(np.float32),
        poses.astype(np.float32),
        targets,
        weights,
        inverse_depth,
        information,
        errors,
    )
    motion = _motion(errors, weights, lengths(targets))
    return MultiView(inverse_depth / np.float32(reach), information, motion.reshape(height, width))


def _motion(errors: np.ndarray, weights: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the mean over matches of error / noise, [h, w]; the noise of a pair of frames is its median error.

    Something that moves may fill most of the image, but rarely its rim: errors that are far smaller there are the noise.
    """
    height, width = errors.shape[:2]
    total, count = np.zeros((height, width), np.float32), np.full((height, width), 1e-6, np.float32)
    rim = np.ones((height, width), bool)
    rim[height // RIM_PARTS : height - height // RIM_PARTS, width // RIM_PARTS : width - width // RIM_PARTS] = False
    for j in range(errors.shape[2]):
        used = weights[..., j] > 0
        if used.any():
            middle = np.median(errors[..., j][used])
            if (used & rim).sum() >= MIN_RIM_MATCHES:
                middle = min(middle, MAX_RIM_NOISE_FACTOR * np.median(errors[..., j][used & rim]))
            noise = 0.1 + 0.01 * lengths[..., j] + middle
            total += np.where(used, errors[..., j] / noise, 0)
            count += used
    return total / count


@inline
def _project(A: np.ndarray, B: np.ndarray, w: np.float32, K: np.ndarray) -> tuple[np.float32, np.float32, np.float32]:
    """Pixel (u, v) and depth of A + w B in a camera with fx, fy, cx, cy = K."""
    z = max(A[2] + w * B[2], np.float32(1e-4))
    return K[0] * (A[0] + w * B[0]) / z + K[2], K[1] * (A[1] + w * B[1]) / z + K[3], z


@kernel
def _solve(
    begin: int, end: int, intrinsics: np.ndarray, poses: np.ndarray, flows: np.ndarray, weights: np.ndarray,
    inverse_depth: np.ndarray, information: np.ndarray, errors: np.ndarray,
) -> None:  # fmt: skip
    """Inverse depth and information [h, w] and the error of each match [h, w, J], all 0 before, of the problem with reach 1."""
    _, w, J = weights.shape
    one, tiny = np.float32(1), np.float32(1e-12)
    scale2 = np.float32(ROBUST_SCALE * ROBUST_SCALE)
    lowest, highest = np.float32(1e-4), np.float32(1e2)
    K0 = intrinsics[0]
    for y in range(begin, end):
        A = np.empty((J, 3), np.float32)
        target = np.empty((J, 2), np.float32)
        for x in range(w):
            dx, dy = (x + np.float32(0.5) - K0[2]) / K0[0], (y + np.float32(0.5) - K0[3]) / K0[1]
            best, best_cost = lowest, np.float32(np.inf)
            known = False
            for j in range(J):
                for r in range(3):
                    A[j, r] = poses[j, r, 0] * dx + poses[j, r, 1] * dy + poses[j, r, 2]
                target[j, 0] = x + np.float32(0.5) + flows[y, x, j, 0]
                target[j, 1] = y + np.float32(0.5) + flows[y, x, j, 1]
            for j in range(J):
                if weights[y, x, j] == 0:
                    continue
                B, K = poses[j, :, 3], intrinsics[j + 1]
                nx, ny = (target[j, 0] - K[2]) / K[0], (target[j, 1] - K[3]) / K[1]
                ax, ay = A[j, 0] - nx * A[j, 2], A[j, 1] - ny * A[j, 2]
                bx, by = B[0] - nx * B[2], B[1] - ny * B[2]
                bb = bx * bx + by * by
                if bb < tiny:
                    continue
                guess = min(max(-(ax * bx + ay * by) / bb, lowest), highest)
                cost = np.float32(0)
                for m in range(J):
                    if weights[y, x, m] > 0:
                        u, v, _ = _project(A[m], poses[m, :, 3], guess, intrinsics[m + 1])
                        r2 = (u - target[m, 0]) ** 2 + (v - target[m, 1]) ** 2
                        cost += weights[y, x, m] * r2 / (r2 + scale2)
                if cost < best_cost:
                    best, best_cost, known = guess, cost, True
            inverse = best
            for _ in range(DEPTH_ITERATIONS if known else 0):
                g, H = np.float32(0), tiny
                for j in range(J):
                    if weights[y, x, j] > 0:
                        B, K = poses[j, :, 3], intrinsics[j + 1]
                        u, v, z = _project(A[j], B, inverse, K)
                        ru, rv = u - target[j, 0], v - target[j, 1]
                        du = (K[0] * B[0] - (u - K[2]) * B[2]) / z
                        dv = (K[1] * B[1] - (v - K[3]) * B[2]) / z
                        weight = weights[y, x, j] / (one + (ru * ru + rv * rv) / scale2)
                        g += weight * (du * ru + dv * rv)
                        H += weight * (du * du + dv * dv)
                inverse = min(max(inverse - g / H, lowest), highest)
            info = np.float32(0)
            for j in range(J):
                if weights[y, x, j] > 0:
                    B, K = poses[j, :, 3], intrinsics[j + 1]
                    u, v, z = _project(A[j], B, inverse if known else lowest, K)
                    ru, rv = u - target[j, 0], v - target[j, 1]
                    r2 = ru * ru + rv * rv
                    du = (K[0] * B[0] - (u - K[2]) * B[2]) / z
                    dv = (K[1] * B[1] - (v - K[3]) * B[2]) / z
                    d2 = du * du + dv * dv
                    weight = weights[y, x, j] / (one + r2 / scale2)
                    info += weight * d2
                    error = np.sqrt(r2)
                    if d2 > tiny:  # The distance from the epipolar line; twice it if that is less than the residual.
                        error = min(error, np.float32(2) * abs(ru * dv - rv * du) / np.sqrt(d2))
                    errors[y, x, j] = error
            if known:
                inverse_depth[y, x] = inverse
                information[y, x] = info * inverse * inverse
