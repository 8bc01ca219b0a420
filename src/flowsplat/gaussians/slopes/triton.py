"""Slopes in the image, and their gradient, in one Triton kernel each. Oracle: ``reference``."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.devices import upload
from flowsplat.common.triton import device_of, rows_per_program
from flowsplat.gaussians.camera_buffer import camera_numbers
from flowsplat.gaussians.slicing import Slice
from flowsplat.gaussians.triton.footprint import footprint
from flowsplat.gaussians.triton.vectors import load_vector
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected


@triton.jit(do_not_specialize=["count"])
def _forward(slopes, conics, radii, means, quats, scales, camera, maps, result, width, height, count, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    drawn = tl.load(radii + i * 2, mask=inside, other=0) > 0
    s0, s1, s2 = load_vector(scales, i, inside)
    p0, p1, _, q0, q1, _, _, _, _ = footprint(means, quats, s0, s1, s2, camera, i, inside, width, height)
    a, b, c = load_vector(conics, i, inside)
    # What is not drawn may lie anywhere, and its conic be anything.
    m00, m01 = tl.where(drawn, a * p0 + b * q0, 0.0), tl.where(drawn, a * p1 + b * q1, 0.0)
    m10, m11 = tl.where(drawn, b * p0 + c * q0, 0.0), tl.where(drawn, b * p1 + c * q1, 0.0)
    first, second = tl.load(slopes + i * 2, mask=inside, other=0.0), tl.load(slopes + i * 2 + 1, mask=inside, other=0.0)
    tl.store(maps + i * 4, m00, mask=inside)
    tl.store(maps + i * 4 + 1, m01, mask=inside)
    tl.store(maps + i * 4 + 2, m10, mask=inside)
    tl.store(maps + i * 4 + 3, m11, mask=inside)
    tl.store(result + i * 2, m00 * first + m01 * second, mask=inside)
    tl.store(result + i * 2 + 1, m10 * first + m11 * second, mask=inside)


@triton.jit(do_not_specialize=["count"])
def _backward(gradient, maps, result, count, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    right, down = tl.load(gradient + i * 2, mask=inside, other=0.0), tl.load(gradient + i * 2 + 1, mask=inside, other=0.0)
    for axis in tl.static_range(2):
        toward_right = tl.load(maps + i * 4 + axis, mask=inside, other=0.0)
        toward_down = tl.load(maps + i * 4 + 2 + axis, mask=inside, other=0.0)
        tl.store(result + i * 2 + axis, toward_right * right + toward_down * down, mask=inside)


class _Slopes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, slopes: Tensor, sliced: Slice, projected: Projected, camera: Camera) -> Tensor:
        assert sliced.quats is not None
        assert sliced.scales is not None
        given = slopes, projected.conics, projected.radii, sliced.means, sliced.quats, sliced.scales
        inputs, count = [tensor.detach().contiguous() for tensor in given], len(slopes)
        maps, result = slopes.new_empty(count, 2, 2), slopes.new_empty(count, 2)
        if count:
            block, size = rows_per_program(count), (float(camera.width), float(camera.height))
            with device_of(slopes):
                numbers = upload(camera_numbers(camera), slopes.device)
                _forward[(triton.cdiv(count, block),)](*inputs, numbers, maps, result, *size, count, BLOCK=block)
        ctx.save_for_backward(maps)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (maps,) = ctx.saved_tensors
        count, result = len(gradient), torch.empty_like(gradient, memory_format=torch.contiguous_format)
        if count:
            block = rows_per_program(count)
            with device_of(gradient):
                _backward[(triton.cdiv(count, block),)](gradient.contiguous(), maps, result, count, BLOCK=block)
        return result, None, None, None


def image_slopes(sliced: Slice, projected: Projected, camera: Camera) -> Tensor:
    """See ``api.image_slopes``."""
    result: Tensor = _Slopes.apply(sliced.slopes, sliced, projected, camera)
    return result
