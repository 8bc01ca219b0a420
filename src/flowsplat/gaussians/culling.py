"""Which Gaussians can be seen at a time by a camera: the cull that comes before anything else."""

from __future__ import annotations

import math

import numpy as np
from numba import float32, njit, prange

from flowsplat.common.kernels import OPTIONS, exp, parallel_kernel

CHUNKS = 64
REACH = np.float32(3.34)
"""More sigmas than the rasterizer ever draws: sqrt(2 ln 255) = 3.33."""
BLUR = np.float32(0.55)
"""More than the standard deviation of the rasterizer's blur in pixels, sqrt(0.3)."""
ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)


@njit(inline="always", **OPTIONS)
def _outside(position, size, center, limit, focal, inverse, picture):
    """Whether a Gaussian ends before the picture on one axis; its 2D sigma is at most focal / z |(1, t)| size + blur."""
    tangent = position * inverse
    clamped = min(max(tangent, -limit), limit)
    reach = REACH * (focal * inverse * size * math.sqrt(ONE + clamped * clamped) + BLUR)
    pixel = focal * tangent + center
    return (pixel + reach < ZERO) or (pixel - reach > picture)


@parallel_kernel
def cull(at_rest, means, log_sizes, times, log_lambdas, t, p_min, use_camera, view, K, width, height, near, keep, counts):
    """Fill keep [N] uint8 (1 = seen at rest, 2 = seen moving) and counts [CHUNKS, 2].

    Gaussians at rest are culled against the camera, never one that it could show; moving ones by presence alone.
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    w, h = float32(width), float32(height)
    limit_x, limit_y = max(w - cx, cx) / fx + float32(0.15) * w / fx, max(h - cy, cy) / fy + float32(0.15) * h / fy
    count = len(at_rest)
    for chunk in prange(CHUNKS):
        resting, moving = 0, 0
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            keep[i] = 0
            if at_rest[i]:
                seen = True
                if use_camera:
                    x, y, z = means[i, 0], means[i, 1], means[i, 2]
                    depth = view[2, 0] * x + view[2, 1] * y + view[2, 2] * z + view[2, 3]
                    seen = depth > near
                    if seen:
                        size = exp(max(log_sizes[i, 0], max(log_sizes[i, 1], log_sizes[i, 2])))
                        right = view[0, 0] * x + view[0, 1] * y + view[0, 2] * z + view[0, 3]
                        down = view[1, 0] * x + view[1, 1] * y + view[1, 2] * z + view[1, 3]
                        inverse = ONE / depth
                        seen = not (
                            _outside(right, size, cx, limit_x, fx, inverse, w) or _outside(down, size, cy, limit_y, fy, inverse, h)
                        )
                if seen:
                    keep[i] = 1
                    resting += 1
            else:
                tau = t - times[i]
                if exp(-HALF * exp(log_lambdas[i]) * tau * tau) >= p_min:
                    keep[i] = 2
                    moving += 1
        counts[chunk, 0] = resting
        counts[chunk, 1] = moving


@parallel_kernel
def collect(keep, counts, rows):
    """Write the kept rows in order, those at rest first."""
    count = len(keep)
    starts = np.empty((CHUNKS, 2), np.int64)
    total = 0
    for kind in range(2):
        for chunk in range(CHUNKS):
            starts[chunk, kind] = total
            total += counts[chunk, kind]
    for chunk in prange(CHUNKS):
        resting, moving = starts[chunk, 0], starts[chunk, 1]
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            if keep[i] == 1:
                rows[resting] = i
                resting += 1
            elif keep[i] == 2:
                rows[moving] = i
                moving += 1
