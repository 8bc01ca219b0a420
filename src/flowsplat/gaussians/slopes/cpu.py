"""Slopes in the image in one sweep over the Gaussians, which keeps what their gradient needs. Oracle: ``reference``."""

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
from flowsplat.splatting.cpu.footprint import footprint, tangent_limits
from flowsplat.splatting.cpu.projection import ZERO

CHUNKS = 64
"""Ranges into which Gaussians are cut, whatever the number of threads."""


@kernel
def _forward(begin, end, slopes, conics, means, quats, scales, drawn, view, K, limits, maps, result):
    count = len(slopes)
    for chunk in range(begin, end):
        turned, L, seen = np.empty((3, 3), np.float32), np.empty((2, 3), np.float32), np.empty(12, np.float32)
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            if drawn[i, 0] > 0:
                footprint(means, quats, scales, i, view, K, limits, turned, L, seen)
                for c in range(2):
                    maps[i, 0, c] = conics[i, 0] * L[0, c] + conics[i, 1] * L[1, c]
                    maps[i, 1, c] = conics[i, 1] * L[0, c] + conics[i, 2] * L[1, c]
            else:
                for c in range(2):
                    maps[i, 0, c], maps[i, 1, c] = ZERO, ZERO
            for c in range(2):
                result[i, c] = maps[i, c, 0] * slopes[i, 0] + maps[i, c, 1] * slopes[i, 1]


class _Slopes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, slopes: Tensor, sliced: Slice, projected: Projected, camera: Camera) -> Tensor:
        assert sliced.quats is not None
        assert sliced.scales is not None
        given = slopes, projected.conics, sliced.means, sliced.quats, sliced.scales, projected.radii
        arrays = [tensor.detach().contiguous().numpy() for tensor in given]
        view, K = camera.viewmat.astype(np.float32), camera.K.astype(np.float32)
        limits = tangent_limits(K, camera.width, camera.height)
        result, ctx.maps = torch.empty(len(slopes), 2), torch.empty(len(slopes), 2, 2)
        parallel_for(_forward, CHUNKS, *arrays, view, K, limits, ctx.maps.numpy(), result.numpy())
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        return (ctx.maps * gradient[:, :, None]).sum(1), None, None, None


def image_slopes(sliced: Slice, projected: Projected, camera: Camera) -> Tensor:
    """See ``api.image_slopes``."""
    result: Tensor = _Slopes.apply(sliced.slopes, sliced, projected, camera)
    return result
