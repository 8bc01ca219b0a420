"""Slopes in the image and their gradient in one sweep over the Gaussians. Oracle: ``reference``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.kernels import kernel
from flowsplat.common.threads import parallel_for
from flowsplat.gaussians.slicing import Slice
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected
from flowsplat.splatting.cpu.footprint import footprint, footprint_gradient, tangent_limits
from flowsplat.splatting.cpu.projection import ZERO

CHUNKS = 64
"""Ranges into which Gaussians are cut, whatever the number of threads."""


@kernel
def _forward(begin, end, slopes, conics, means, quats, scales, drawn, view, K, limits, result):
    count = len(slopes)
    for chunk in range(begin, end):
        turned, L, seen = np.empty((3, 3), np.float32), np.empty((2, 3), np.float32), np.empty(12, np.float32)
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            result[i, 0], result[i, 1] = ZERO, ZERO
            if drawn[i, 0] > 0:
                footprint(means, quats, scales, i, view, K, limits, turned, L, seen)
                p, q = slopes[i, 0], slopes[i, 1]
                x, y = L[0, 0] * p + L[0, 1] * q, L[1, 0] * p + L[1, 1] * q
                result[i, 0] = conics[i, 0] * x + conics[i, 1] * y
                result[i, 1] = conics[i, 1] * x + conics[i, 2] * y


@kernel
def _backward(
    begin, end, gradient, slopes, conics, means, quats, scales, drawn, view, K, limits, d_slopes, d_conics, d_means, d_quats,
    d_scales,
):  # fmt: skip
    count = len(slopes)
    for chunk in range(begin, end):
        turned, L, seen = np.empty((3, 3), np.float32), np.empty((2, 3), np.float32), np.empty(12, np.float32)
        d_L = np.zeros((2, 3), np.float32)
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            for c in range(3):
                d_conics[i, c], d_means[i, c], d_scales[i, c] = ZERO, ZERO, ZERO
            for c in range(4):
                d_quats[i, c] = ZERO
            d_slopes[i, 0], d_slopes[i, 1] = ZERO, ZERO
            if drawn[i, 0] > 0:
                footprint(means, quats, scales, i, view, K, limits, turned, L, seen)
                p, q, g, h = slopes[i, 0], slopes[i, 1], gradient[i, 0], gradient[i, 1]
                x, y = L[0, 0] * p + L[0, 1] * q, L[1, 0] * p + L[1, 1] * q
                d_conics[i, 0], d_conics[i, 1], d_conics[i, 2] = g * x, g * y + h * x, h * y
                dx, dy = conics[i, 0] * g + conics[i, 1] * h, conics[i, 1] * g + conics[i, 2] * h
                d_slopes[i, 0], d_slopes[i, 1] = L[0, 0] * dx + L[1, 0] * dy, L[0, 1] * dx + L[1, 1] * dy
                d_L[0, 0], d_L[0, 1], d_L[1, 0], d_L[1, 1] = dx * p, dx * q, dy * p, dy * q
                footprint_gradient(quats, scales, i, view, K, turned, seen, d_L, ZERO, ZERO, d_means[i], d_quats[i], d_scales[i])


class _Slopes(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, slopes: Tensor, conics: Tensor, means: Tensor, quats: Tensor, scales: Tensor, radii: Tensor, camera: Camera
    ) -> Tensor:
        inputs = [tensor.detach().contiguous().numpy() for tensor in (slopes, conics, means, quats, scales, radii)]
        view, K = camera.viewmat.astype(np.float32), camera.K.astype(np.float32)
        ctx.inputs = *inputs, view, K, tangent_limits(K, camera.width, camera.height)
        result = torch.empty(len(slopes), 2)
        parallel_for(_forward, CHUNKS, *ctx.inputs, result.numpy())
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        results = [torch.empty(len(gradient), size) for size in (2, 3, 3, 4, 3)]
        parallel_for(_backward, CHUNKS, gradient.contiguous().numpy(), *ctx.inputs, *(result.numpy() for result in results))
        return *results, None, None


def image_slopes(sliced: Slice, projected: Projected, camera: Camera) -> Tensor:
    """See ``api.image_slopes``."""
    result: Tensor = _Slopes.apply(
        sliced.slopes, projected.conics, sliced.means, sliced.quats, sliced.scales, projected.radii, camera
    )
    return result
