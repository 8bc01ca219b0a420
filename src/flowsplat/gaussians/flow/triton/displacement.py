"""The features of color, depth and displacement flow, and their gradient, in one Triton kernel each. Oracle: ``reference``.

There is always a last channel for what the other camera does not see, so that the host need not wait to learn whether it is needed.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.devices import upload
from flowsplat.common.triton import device_of, rows_per_program
from flowsplat.gaussians.camera_buffer import CX, CY, FX, FY, camera_numbers, to_camera, to_world
from flowsplat.gaussians.flow.reference import FLOW_NEAR_PLANE
from flowsplat.gaussians.slicing import Slice
from flowsplat.gaussians.triton.vectors import load_vector, store_vector
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected

CHANNELS = 7
"""Color 3, depth, flow 2, unseen."""
NEAR_CLIP = tl.constexpr(FLOW_NEAR_PLANE)


@triton.jit(do_not_specialize=["count"])
def _forward(colors, depths, means2d, next_means, camera, features, count, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    red, green, blue = load_vector(colors, i, inside)
    x, y, z = load_vector(next_means, i, inside)
    x, y, z = to_camera(camera, x, y, z)
    front = z > NEAR_CLIP
    inverse = 1.0 / tl.where(front, z, 1.0)
    u = tl.load(camera + FX) * x * inverse + tl.load(camera + CX) - tl.load(means2d + i * 2, mask=inside, other=0.0)
    v = tl.load(camera + FY) * y * inverse + tl.load(camera + CY) - tl.load(means2d + i * 2 + 1, mask=inside, other=0.0)
    row = features + i * 7
    tl.store(row, red, mask=inside)
    tl.store(row + 1, green, mask=inside)
    tl.store(row + 2, blue, mask=inside)
    tl.store(row + 3, tl.load(depths + i, mask=inside, other=0.0), mask=inside)
    tl.store(row + 4, tl.where(front, u, 0.0), mask=inside)
    tl.store(row + 5, tl.where(front, v, 0.0), mask=inside)
    tl.store(row + 6, tl.where(front, 0.0, 1.0), mask=inside)


@triton.jit(do_not_specialize=["count"])
def _backward(gradient, next_means, camera, d_colors, d_depths, d_means2d, d_next_means, count, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    row = gradient + i * 7
    red, green, blue = load_vector(next_means, i, inside)
    x, y, z = to_camera(camera, red, green, blue)
    front = z > NEAR_CLIP
    gu = tl.where(front, tl.load(row + 4, mask=inside, other=0.0), 0.0)
    gv = tl.where(front, tl.load(row + 5, mask=inside, other=0.0), 0.0)
    inverse = 1.0 / tl.where(front, z, 1.0)
    dx, dy = gu * tl.load(camera + FX) * inverse, gv * tl.load(camera + FY) * inverse
    dz = tl.where(front, -(dx * x + dy * y) * inverse, 0.0)
    wx, wy, wz = to_world(camera, dx, dy, dz)
    store_vector(d_next_means, i, wx, wy, wz, inside)
    tl.store(d_means2d + i * 2, -gu, mask=inside)
    tl.store(d_means2d + i * 2 + 1, -gv, mask=inside)
    tl.store(d_depths + i, tl.load(row + 3, mask=inside, other=0.0), mask=inside)
    red, green = tl.load(row, mask=inside, other=0.0), tl.load(row + 1, mask=inside, other=0.0)
    store_vector(d_colors, i, red, green, tl.load(row + 2, mask=inside, other=0.0), inside)


def compute_displacement_features(colors: Tensor, depths: Tensor, means2d: Tensor, next_means: Tensor, camera: Tensor) -> Tensor:
    """Return [A, 7] without gradients; ``camera``: ``camera_numbers`` of the other camera on the device."""
    count = len(colors)
    features = torch.empty(count, CHANNELS, device=colors.device)
    if count:
        block = rows_per_program(count)
        with device_of(colors):
            _forward[(triton.cdiv(count, block),)](colors, depths, means2d, next_means, camera, features, count, BLOCK=block)
    return features


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, colors: Tensor, depths: Tensor, means2d: Tensor, next_means: Tensor, camera: Tensor) -> Tensor:
        ctx.save_for_backward(next_means, camera)
        colors, depths, means2d, next_means = (tensor.detach().contiguous() for tensor in (colors, depths, means2d, next_means))
        return compute_displacement_features(colors, depths, means2d, next_means, camera)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        next_means, camera = ctx.saved_tensors
        count, device = len(gradient), gradient.device
        results = [torch.empty(shape, device=device) for shape in ((count, 3), (count,), (count, 2), (count, 3))]
        if count:
            block = rows_per_program(count)
            with device_of(gradient):
                _backward[(triton.cdiv(count, block),)](
                    gradient.contiguous(), next_means.contiguous(), camera, *results, count, BLOCK=block
                )
        return *results, None


def blend_displacement(sliced: Slice, projected: Projected, other: Camera) -> Tensor:
    """See ``api.blend_features``; flow goes to the Gaussians' ``next_means`` in the ``other`` camera."""
    assert sliced.next_means is not None
    camera = upload(camera_numbers(other), sliced.means.device)
    result: Tensor = _Features.apply(sliced.colors, projected.depths, projected.means2d, sliced.next_means, camera)
    return result
