"""The kernels as two differentiable torch functions, projecting and blending, with the signatures of ``cpu.functions``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import triton
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.devices import Later
from flowsplat.common.triton import device_of, power_of_two, rows_per_program
from flowsplat.splatting.rules import SLOPED_FEATURES
from flowsplat.splatting.triton import blending, tiles
from flowsplat.splatting.triton import projection as kernels
from flowsplat.splatting.triton.tiles import Binned, Counted


def _ready(tensor: Tensor) -> Tensor:
    return tensor.detach().to(torch.float32).contiguous()


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None,
                opacities: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, near: float, far: float,
                eps2d: float) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        count, device = len(means), means.device
        inputs = tuple(None if value is None else _ready(value) for value in (means, quats, scales, covars))
        camera = _ready(viewmat), _ready(K)
        means2d, conics = torch.empty(count, 2, device=device), torch.empty(count, 3, device=device)
        depths, extents = torch.empty(count, device=device), torch.empty(count, device=device)
        radii = torch.empty(count, 2, dtype=torch.int32, device=device)
        if count > 0:
            block = rows_per_program(count)
            with device_of(means):
                kernels.project_forward[(triton.cdiv(count, block),)](
                    *inputs, _ready(opacities), *camera, means2d, conics, depths, radii, extents, count, width, height,
                    float(near), float(far), float(eps2d), HAS_COVARS=covars is not None, BLOCK=block,
                )  # fmt: skip
        ctx.mark_non_differentiable(radii, extents)
        ctx.set_materialize_grads(False)
        # All that backward reads: what is written into it in the meantime would give a wrong gradient, and torch refuses that.
        ctx.save_for_backward(means, quats, scales, covars, viewmat, K, radii, conics)
        ctx.size = width, height, float(eps2d)
        return means2d, conics, depths, radii, extents

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_means2d: Tensor | None, grad_conics: Tensor | None, grad_depths: Tensor | None,
                 *_: Any) -> tuple[Tensor | None, ...]:  # fmt: skip
        *given_inputs, radii, conics = ctx.saved_tensors
        ready: Any = [None if value is None else _ready(value) for value in given_inputs]
        means, quats, scales, covars, viewmat, K = ready
        count, device = len(means), means.device
        given = [
            torch.zeros(count, *shape, device=device) if gradient is None else _ready(gradient)
            for gradient, shape in ((grad_means2d, (2,)), (grad_conics, (3,)), (grad_depths, ()))
        ]
        wants_camera = ctx.needs_input_grad[5] or ctx.needs_input_grad[6]
        grad_means, grad_quats, grad_scales, grad_covars = (
            None if value is None else torch.empty_like(value) for value in (means, quats, scales, covars)
        )
        block = rows_per_program(count)
        programs = triton.cdiv(count, block)
        grad_camera = torch.empty(programs, kernels.CAMERA, device=device) if wants_camera else None
        if count > 0:
            with device_of(means):
                kernels.project_backward[(programs,)](
                    means, quats, scales, covars, viewmat, K, radii, conics, *given, grad_means, grad_quats,
                    grad_scales, grad_covars, grad_camera, count, *ctx.size, HAS_COVARS=covars is not None,
                    WANTS_CAMERA=wants_camera, BLOCK=block,
                )  # fmt: skip
        grad_view = grad_K = None
        if grad_camera is not None:
            camera = grad_camera.sum(0, dtype=torch.float64).to(torch.float32)
            grad_view, grad_K = torch.zeros(4, 4, device=device), torch.zeros(3, 3, device=device)
            grad_view[:3] = camera[:12].reshape(3, 4)
            grad_K[0, 0], grad_K[1, 1], grad_K[0, 2], grad_K[1, 2] = camera[12:]
        return (
            grad_means, grad_quats, grad_scales, grad_covars, None, grad_view, grad_K, None, None, None, None, None,
        )  # fmt: skip


@dataclass(frozen=True)
class _Blended:
    """An image, and what backward needs of how it was made."""

    image: Tensor
    alphas: Tensor
    transmittance: Tensor
    stops: Tensor
    counted: Counted
    binned: Binned


def _blend(inputs: tuple[Tensor, ...], width: int, height: int, save: bool) -> _Blended:
    """Blend means2d, conics, opacities, features, depths and extents, float32; ``save``: so that backward can replay it."""
    xy, conic, opacity, feature, depth, extent = inputs
    device, fixed = xy.device, tiles.get_fixed_capacity()
    if fixed is None and xy.is_cuda and torch.cuda.is_current_stream_capturing():
        raise RuntimeError("a CUDA graph cannot wait for the GPU: capture it inside `with PairCapacity.fix():` (triton.tiles)")
    counted = tiles.count_tiles(xy, conic, opacity, depth, extent, width, height)
    if fixed is not None:
        fixed.note(counted.needed)
        return _blend_counted(counted, xy, conic, opacity, feature, extent, width, height, fixed.pairs, save)
    shared, later = tiles.get_shared_capacity(device, width, height), Later(counted.needed)
    while True:
        capacity = shared.pairs
        blended = _blend_counted(counted, xy, conic, opacity, feature, extent, width, height, capacity, save)
        # Only now: the GPU has enough to do while the host waits for a number that was counted before all that.
        (needed,) = later.values()
        if needed <= capacity:
            return blended
        shared.grow(needed)


def _blend_counted(
    counted: Counted, xy: Tensor, conic: Tensor, opacity: Tensor, feature: Tensor, extent: Tensor, width: int, height: int,
    capacity: int, save: bool,
) -> _Blended:  # fmt: skip
    """Blend at most ``capacity`` pairs of a Gaussian and a tile."""
    binned = tiles.fill_tiles(counted, xy, conic, opacity, extent, width, height, capacity)
    columns, rows = tiles.tile_grid(width, height)
    channels, device = feature.shape[1], xy.device
    image, alphas = torch.empty(height, width, channels, device=device), torch.empty(height, width, device=device)
    transmittance = torch.empty_like(alphas) if save else alphas
    stops = torch.empty(columns * rows if save else 0, dtype=torch.int32, device=device)
    blending.blend_forward[(columns * rows,)](
        counted.records, feature, binned.gaussians, binned.offsets, image, alphas, transmittance, stops, width, height, columns,
        CHANNELS=channels, PADDED=power_of_two(channels), SAVE=save, CHECK_EVERY=blending.CHECK_EVERY,
        TOGETHER=blending.GAUSSIANS_PER_STEP, num_warps=blending.FORWARD_WARPS,
    )  # fmt: skip
    return _Blended(image, alphas, transmittance, stops, counted, binned)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, depths: Tensor,
                extents: Tensor, width: int, height: int, absolute: Tensor | None) -> tuple[Tensor, Tensor]:  # fmt: skip
        inputs = tuple(map(_ready, (means2d, conics, opacities, features, depths, extents)))
        with device_of(means2d):
            blended = _blend(inputs, width, height, save=True)
        ctx.save_for_backward(blended.image, blended.transmittance, opacities, features)
        ctx.size, ctx.absolute = (width, height), absolute
        ctx.stops, ctx.counted, ctx.binned = blended.stops, blended.counted, blended.binned
        ctx.set_materialize_grads(False)
        return blended.image, blended.alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_alphas: Tensor | None) -> tuple[Tensor | None, ...]:
        image, transmittance, opacities, features = ctx.saved_tensors
        opacity, feature = _ready(opacities), _ready(features)
        (width, height), counted, binned = ctx.size, ctx.counted, ctx.binned
        (count, channels), device = feature.shape, image.device
        columns, rows = tiles.tile_grid(width, height)
        capacity = len(binned.slots)
        # Zeros: behind the place where a tile stopped nothing is written.
        stride = -(-(blending.GEOMETRY + channels) // 4) * 4
        out = torch.zeros(capacity, stride, device=device)
        grad_means2d, grad_conics = torch.empty(count, 2, device=device), torch.empty(count, 3, device=device)
        grad_opacities, grad_features = torch.empty(count, device=device), torch.empty(count, channels, device=device)
        with device_of(image):
            blending.blend_backward[(columns * rows,)](
                counted.records, feature, binned.gaussians, binned.slots, binned.offsets, ctx.stops, image, transmittance,
                torch.zeros_like(image) if grad_image is None else _ready(grad_image),
                torch.zeros_like(transmittance) if grad_alphas is None else _ready(grad_alphas), out, width, height, columns,
                CHANNELS=channels, PADDED=power_of_two(channels), STRIDE=stride, ABSOLUTE=ctx.absolute is not None,
                num_warps=blending.BACKWARD_WARPS,
            )  # fmt: skip
            blending.gather_gradients[(count,)](
                counted.order, counted.counts, counted.ends, out, opacity, grad_means2d, grad_conics, grad_opacities,
                grad_features, ctx.absolute, capacity, CHANNELS=channels, COLUMNS=power_of_two(blending.GEOMETRY + channels),
                STRIDE=stride, ROWS=blending.SUMMED_ROWS, ABSOLUTE=ctx.absolute is not None, num_warps=1,
            )  # fmt: skip
        return grad_means2d, grad_conics, grad_opacities, grad_features, None, None, None, None, None


def project(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    *rest: Any,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """As ``reference.project``, and the squared sigmas [N] within which each Gaussian is drawn (0 where culled).

    The camera may be on another device than the Gaussians.
    """
    camera = viewmat.to(means.device), K.to(means.device)
    result: tuple[Tensor, Tensor, Tensor, Tensor, Tensor] = _Project.apply(means, quats, scales, covars, opacities, *camera, *rest)
    return result


def blend(
    means2d: Tensor,  # [N, 2]
    conics: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    features: Tensor,  # [N, C]
    depths: Tensor,  # [N]
    extents: Tensor,  # [N]
    width: int,
    height: int,
    absolute: Tensor | None = None,  # [N, 2]
    slopes: Tensor | None = None,  # [N, 2]
) -> tuple[Tensor, Tensor]:
    """As ``reference.blend``, with the extents of ``project`` in place of the radii. Keeps nothing without a gradient.

    What slopes add is linear in the pixel, so it is blended as two more features and put together afterwards.
    """
    if slopes is not None:
        right, down = means2d[:, :1] - width / 2, means2d[:, 1:] - height / 2
        at_middle = features[:, :SLOPED_FEATURES] - slopes[:, :1] * right - slopes[:, 1:] * down
        features = torch.cat([at_middle, features[:, SLOPED_FEATURES:], slopes], 1)
        image, alphas = blend(means2d, conics, opacities, features, depths, extents, width, height, absolute)
        x = torch.arange(width, device=image.device, dtype=image.dtype) + 0.5 - width / 2
        y = torch.arange(height, device=image.device, dtype=image.dtype) + 0.5 - height / 2
        added = image[..., -2:-1] * x[None, :, None] + image[..., -1:] * y[:, None, None]
        return torch.cat([image[..., :SLOPED_FEATURES] + added, image[..., SLOPED_FEATURES:-2]], 2), alphas
    inputs = means2d, conics, opacities, features
    if len(means2d) == 0:
        nothing = sum(value.sum() for value in inputs)
        return features.new_zeros(height, width, features.shape[1]) + nothing, features.new_zeros(height, width) + nothing
    if torch.is_grad_enabled() and any(value.requires_grad for value in inputs):
        result: tuple[Tensor, Tensor] = _Blend.apply(*inputs, depths, extents, width, height, absolute)
        return result
    with device_of(means2d):
        blended = _blend(tuple(map(_ready, (*inputs, depths, extents))), width, height, save=False)
    return blended.image, blended.alphas
