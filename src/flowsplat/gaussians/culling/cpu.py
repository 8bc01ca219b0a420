"""The cull in one sweep over the Gaussians and a second one over what is left. Oracle: ``reference``."""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import float32
from torch import Tensor

from flowsplat.common.kernels import exp, inline, kernel
from flowsplat.common.threads import parallel_for
from flowsplat.gaussians.culling import reference
from flowsplat.geometry import Camera
from flowsplat.splatting.rules import TANGENT_MARGIN

CHUNKS = 64
"""Ranges into which Gaussians are cut, whatever the number of threads."""
CULL_SIGMAS, BLUR_RADIUS, CULL_MARGIN = (
    np.float32(reference.CULL_SIGMAS),
    np.float32(reference.BLUR_SIGMA),
    np.float32(TANGENT_MARGIN),
)
ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)


@inline
def _outside(position, size, center, limit, focal, inverse, image):
    """Whether a Gaussian ends before the image on one axis; its 2D sigma is at most focal / z |(1, t)| size + blur."""
    tangent = position * inverse
    clamped = min(max(tangent, -limit), limit)
    reach = CULL_SIGMAS * (focal * inverse * size * math.sqrt(ONE + clamped * clamped) + BLUR_RADIUS)
    pixel = focal * tangent + center
    return (pixel + reach < ZERO) or (pixel - reach > image)


@kernel
def _cull(
    begin, end, at_rest, means, log_sizes, times, log_lambdas, t, p_min, use_camera, view, K, width, height, near, keep, counts
):
    """Fill keep [N] uint8 (1 = seen at rest, 2 = seen moving) and counts [CHUNKS, 2]."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    w, h = float32(width), float32(height)
    limit_x, limit_y = max(w - cx, cx) / fx + CULL_MARGIN * w / fx, max(h - cy, cy) / fy + CULL_MARGIN * h / fy
    count = len(at_rest)
    for chunk in range(begin, end):
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


@kernel
def _collect(begin, end, keep, starts, rows):
    """Write the kept rows in order, those at rest first; starts [CHUNKS, 2] is where those of a chunk begin."""
    count = len(keep)
    for chunk in range(begin, end):
        resting, moving = starts[chunk, 0], starts[chunk, 1]
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            if keep[i] == 1:
                rows[resting] = i
                resting += 1
            elif keep[i] == 2:
                rows[moving] = i
                moving += 1


_NO_CAMERA = Camera(np.eye(4), np.eye(3), 1, 1)


def active_rows(
    at_rest: Tensor, means: Tensor, log_scales: Tensor | None, times: Tensor, log_lambdas: Tensor, t: float, p_min: float,
    camera: Camera | None, near: float,
) -> tuple[Tensor, int]:  # fmt: skip
    """See ``api.active_rows``; any float type."""
    use_camera = camera is not None and log_scales is not None
    camera = camera or _NO_CAMERA
    viewmat, K = camera.tensors()
    sizes = means if log_scales is None else log_scales
    keep, counts = np.empty(len(means), np.uint8), np.empty((CHUNKS, 2), np.int64)
    parallel_for(
        _cull, CHUNKS, at_rest.numpy(), means.numpy(), sizes.numpy(), times.numpy(), log_lambdas.numpy(), np.float32(t),
        np.float32(p_min),
        use_camera, viewmat.numpy(), K.numpy(), camera.width, camera.height, np.float32(near), keep, counts,
    )  # fmt: skip
    rows = torch.empty(int(counts.sum()), dtype=torch.int64)
    ends = counts.T.cumsum().reshape(2, CHUNKS).T
    parallel_for(_collect, CHUNKS, keep, ends - counts, rows.numpy())
    return rows, int(counts[:, 0].sum())
