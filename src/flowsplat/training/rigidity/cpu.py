"""The rigid loss and its gradient in one sweep over the Gaussians. Oracle: ``reference``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.kernels import inline, kernel
from flowsplat.common.threads import parallel_for
from flowsplat.training.rigidity import reference
from flowsplat.training.rigidity.neighbors import Neighbors

CHUNKS = 64
"""Ranges into which Gaussians are cut, whatever the number of threads, so that sums do not depend on it."""
NORM_EPSILON, ZERO, ONE = np.float32(reference.NORM_EPSILON), np.float32(0), np.float32(1)


@inline
def _difference(velocities, a, b):
    """v_a - v_b and the inverse of its safe norm."""
    x, y, z = velocities[a, 0] - velocities[b, 0], velocities[a, 1] - velocities[b, 1], velocities[a, 2] - velocities[b, 2]
    return x, y, z, ONE / math.sqrt(x * x + y * y + z * z + NORM_EPSILON)


@kernel
def _loss_and_gradient(begin, end, velocities, rows, place, indices, weights, offsets, pairs, sums, gradient):
    """sums [CHUNKS] and gradient [M, 3], not yet divided; place [N] is the position of a Gaussian among the rows, or -1."""
    count, k = len(rows), indices.shape[1]
    for chunk in range(begin, end):
        total = 0.0
        for a in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            i = rows[a]
            gx, gy, gz = ZERO, ZERO, ZERO
            for n in range(k):
                j = indices[i, n]
                b = place[j] if j >= 0 else -1
                if b >= 0:
                    x, y, z, inverse = _difference(velocities, a, b)
                    pull = weights[i, n] * inverse
                    total += float32(pull * (x * x + y * y + z * z + NORM_EPSILON))
                    gx += pull * x
                    gy += pull * y
                    gz += pull * z
            for p in range(offsets[i], offsets[i + 1]):
                source = pairs[p] // k
                b = place[source]
                if b >= 0:
                    x, y, z, inverse = _difference(velocities, a, b)
                    pull = weights[source, pairs[p] - source * k] * inverse
                    gx += pull * x
                    gy += pull * y
                    gz += pull * z
            gradient[a, 0] = gx
            gradient[a, 1] = gy
            gradient[a, 2] = gz
        sums[chunk] = total


class _RigidLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, velocities: Tensor, rows: Tensor, neighbors: Neighbors, count: int | Tensor) -> Tensor:
        place = np.full(len(neighbors), -1, np.int32)
        place[rows.numpy()] = np.arange(len(rows), dtype=np.int32)
        sums, gradient = np.empty(CHUNKS), torch.empty(len(rows), 3)
        parallel_for(
            _loss_and_gradient, CHUNKS, velocities.detach().contiguous().numpy(), rows.numpy(), place, neighbors.indices.numpy(),
            neighbors.weights.numpy(), *(t.numpy() for t in neighbors.incoming), sums, gradient.numpy(),
        )  # fmt: skip
        ctx.share = float(1 / (neighbors.indices.shape[1] * count))
        ctx.save_for_backward(gradient)
        return velocities.new_tensor(ctx.share * sums.sum())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        return grad * ctx.share * ctx.saved_tensors[0], None, None, None


def rigid_loss(velocities: Tensor, rows: Tensor, neighbors: Neighbors, count: int | Tensor) -> Tensor:
    """See ``api.rigid_loss``."""
    result: Tensor = _RigidLoss.apply(velocities, rows, neighbors, count)
    return result
