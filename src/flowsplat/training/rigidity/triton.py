"""The rigid loss and its gradient as one Triton kernel, a lane a Gaussian. Oracle: ``reference``.

As in ``cpu`` a Gaussian's gradient is a sum over its own pairs and over those that name it, in a fixed order: there are no atomic
additions, and the same input gives the same bits. A row of -1 is padding, without neighbors and with a gradient of 0.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.triton import device_of, rows_per_program
from flowsplat.training.rigidity import reference
from flowsplat.training.rigidity.neighbors import Neighbors

NORM_EPSILON = tl.constexpr(reference.NORM_EPSILON)


@triton.jit
def _difference(velocities, x, y, z, b, mask):
    """v - v_b, and the safe norm."""
    x -= tl.load(velocities + b * 3, mask=mask, other=0.0)
    y -= tl.load(velocities + b * 3 + 1, mask=mask, other=0.0)
    z -= tl.load(velocities + b * 3 + 2, mask=mask, other=0.0)
    return x, y, z, tl.sqrt(x * x + y * y + z * z + NORM_EPSILON)


@triton.jit(do_not_specialize=["count"])
def _loss_and_gradient(
    velocities, rows, place, indices, weights, offsets, pairs, sums, gradient, count, SIZE: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """sums [programs] and gradient [M, 3], not yet divided; place [N + 1] is the position of a Gaussian among the rows, or -1."""
    a = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = a < count
    i = tl.load(rows + a, mask=inside, other=-1)
    there = i >= 0
    i = tl.maximum(i, 0)
    x = tl.load(velocities + a * 3, mask=inside, other=0.0)
    y = tl.load(velocities + a * 3 + 1, mask=inside, other=0.0)
    z = tl.load(velocities + a * 3 + 2, mask=inside, other=0.0)
    total, gx, gy, gz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for n in range(SIZE):
        j = tl.load(indices + i * SIZE + n, mask=there, other=-1)
        known = there & (j >= 0)
        b = tl.load(place + j, mask=known, other=-1)
        known = known & (b >= 0)
        weight = tl.load(weights + i * SIZE + n, mask=known, other=0.0)
        dx, dy, dz, norm = _difference(velocities, x, y, z, b, known)
        pull = weight / norm
        total += weight * norm
        gx += pull * dx
        gy += pull * dy
        gz += pull * dz
    begin = tl.load(offsets + i, mask=there, other=0)
    number = (tl.load(offsets + i + 1, mask=there, other=0) - begin).to(tl.int32)
    longest = tl.max(number, 0)
    p = 0
    while p < longest:
        known = there & (p < number)
        pair = tl.load(pairs + begin + p, mask=known, other=0)
        b = tl.load(place + pair // SIZE, mask=known, other=-1)
        known = known & (b >= 0)
        dx, dy, dz, norm = _difference(velocities, x, y, z, b, known)
        pull = tl.load(weights + pair, mask=known, other=0.0) / norm
        gx += pull * dx
        gy += pull * dy
        gz += pull * dz
        p += 1
    tl.store(gradient + a * 3, gx, mask=inside)
    tl.store(gradient + a * 3 + 1, gy, mask=inside)
    tl.store(gradient + a * 3 + 2, gz, mask=inside)
    tl.store(sums + tl.program_id(0), tl.sum(total, 0))


class _RigidLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, velocities: Tensor, rows: Tensor, neighbors: Neighbors, count: int | Tensor) -> Tensor:
        moving, device = len(rows), rows.device
        # The last one is where padding, -1, points to; as a neighbor it is not looked up.
        place = torch.full((len(neighbors) + 1,), -1, dtype=torch.int32, device=device)
        place[rows] = torch.arange(moving, dtype=torch.int32, device=device)
        block = rows_per_program(moving)
        programs = triton.cdiv(moving, block)
        sums, gradient = torch.empty(programs, device=device), torch.empty(moving, 3, device=device)
        if moving:
            with device_of(velocities):
                _loss_and_gradient[(programs,)](
                    velocities.detach().contiguous(), rows, place, neighbors.indices, neighbors.weights, *neighbors.incoming,
                    sums, gradient, moving, SIZE=neighbors.indices.shape[1], BLOCK=block,
                )  # fmt: skip
        share = 1 / (neighbors.indices.shape[1] * count)
        ctx.save_for_backward(share * gradient)
        return (share * sums.sum(dtype=torch.float64)).to(torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        return grad * ctx.saved_tensors[0], None, None, None


def rigid_loss(velocities: Tensor, rows: Tensor, neighbors: Neighbors, count: int | Tensor) -> Tensor:
    """See ``reference.rigid_loss``."""
    result: Tensor = _RigidLoss.apply(velocities, rows, neighbors, count)
    return result
