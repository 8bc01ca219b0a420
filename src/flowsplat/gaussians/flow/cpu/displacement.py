"""The features of color, depth and displacement flow, and their gradient, in one sweep. Oracle: ``reference``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.kernels import kernel
from flowsplat.common.threads import parallel_for
from flowsplat.gaussians.flow.reference import FLOW_NEAR_PLANE
from flowsplat.gaussians.slicing import Slice
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected

CHANNELS = 6
"""Channels of a Gaussian: color 3, depth, flow 2."""
ONE, ZERO, NEAR_CLIP = np.float32(1), np.float32(0), np.float32(FLOW_NEAR_PLANE)


@kernel
def _forward(begin, end, colors, depths, means2d, next_means, drawn, view, K, features, hidden):
    """Fill features [A, 6 or 7]; hidden [1] becomes 1 where the other camera does not see a Gaussian that is drawn."""
    for i in range(begin, end):
        for c in range(3):
            features[i, c] = colors[i, c]
        features[i, 3] = depths[i]
        px, py, pz = next_means[i, 0], next_means[i, 1], next_means[i, 2]
        z = view[2, 0] * px + view[2, 1] * py + view[2, 2] * pz + view[2, 3]
        front = z > NEAR_CLIP
        features[i, 4] = ZERO
        features[i, 5] = ZERO
        if front:
            inverse = ONE / z
            x = view[0, 0] * px + view[0, 1] * py + view[0, 2] * pz + view[0, 3]
            y = view[1, 0] * px + view[1, 1] * py + view[1, 2] * pz + view[1, 3]
            features[i, 4] = K[0, 0] * x * inverse + K[0, 2] - means2d[i, 0]
            features[i, 5] = K[1, 1] * y * inverse + K[1, 2] - means2d[i, 1]
        elif drawn[i, 0] > 0:
            hidden[0] = 1
        if features.shape[1] > CHANNELS:
            features[i, CHANNELS] = ZERO if front else ONE


@kernel
def _backward(begin, end, gradient, next_means, view, K, d_colors, d_depths, d_means2d, d_next_means):
    fx, fy = K[0, 0], K[1, 1]
    for i in range(begin, end):
        for c in range(3):
            d_colors[i, c] = gradient[i, c]
        d_depths[i] = gradient[i, 3]
        px, py, pz = next_means[i, 0], next_means[i, 1], next_means[i, 2]
        z = view[2, 0] * px + view[2, 1] * py + view[2, 2] * pz + view[2, 3]
        front = z > NEAR_CLIP
        gu, gv = gradient[i, 4] if front else ZERO, gradient[i, 5] if front else ZERO
        d_means2d[i, 0] = -gu
        d_means2d[i, 1] = -gv
        inverse = ONE / z if front else ZERO
        x = view[0, 0] * px + view[0, 1] * py + view[0, 2] * pz + view[0, 3]
        y = view[1, 0] * px + view[1, 1] * py + view[1, 2] * pz + view[1, 3]
        dx, dy = gu * fx * inverse, gv * fy * inverse
        dz = -(dx * x + dy * y) * inverse
        for d in range(3):
            d_next_means[i, d] = view[0, d] * dx + view[1, d] * dy + view[2, d] * dz


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, colors: Tensor, depths: Tensor, means2d: Tensor, next_means: Tensor, radii: Tensor, camera: Camera
    ) -> Tensor:
        view, K = (tensor.numpy() for tensor in camera.tensors())
        inputs = [_array(tensor) for tensor in (colors, depths, means2d, next_means, radii)]
        features, hidden = torch.empty(len(colors), CHANNELS), np.zeros(1, np.uint8)
        parallel_for(_forward, len(colors), *inputs, view, K, features.numpy(), hidden)
        if hidden[0]:
            features = torch.empty(len(colors), CHANNELS + 1)
            parallel_for(_forward, len(colors), *inputs, view, K, features.numpy(), hidden)
        ctx.save_for_backward(next_means)
        ctx.camera = view, K
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (next_means,), count = ctx.saved_tensors, len(gradient)
        results = torch.empty(count, 3), torch.empty(count), torch.empty(count, 2), torch.empty(count, 3)
        parallel_for(_backward, count, _array(gradient), _array(next_means), *ctx.camera, *(result.numpy() for result in results))
        return *results, None, None


def blend_displacement(sliced: Slice, projected: Projected, other: Camera) -> Tensor:
    """See ``api.blend_features``; flow goes to the Gaussians' ``next_means`` in the ``other`` camera."""
    assert sliced.next_means is not None
    result: Tensor = _Features.apply(sliced.colors, projected.depths, projected.means2d, sliced.next_means, projected.radii, other)
    return result
