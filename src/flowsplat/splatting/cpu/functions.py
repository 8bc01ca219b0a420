"""The kernels as two differentiable torch functions: projecting and blending."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.threads import parallel_for, thread_count
from flowsplat.splatting.cpu import blending, tiles
from flowsplat.splatting.cpu import projection as kernels
from flowsplat.splatting.cpu.workspace import Lease

MAX_INSTANCES = 2**31 - 1
"""Pairs of a Gaussian and a tile, at most: what a signed 32-bit index reaches."""
MAX_CHANNELS = 64
"""Of one blending: of more, each piece is blended by itself. Chosen by eye."""
_CHUNKS = 16
"""Fixed, so that sums over chunks do not depend on the number of threads."""
_BLEND_PIECES = 16
"""For each thread: some tiles are far fuller than others."""


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().to(torch.float32).contiguous().numpy()


_NO_QUATS, _NO_SCALES = np.zeros((0, 4), np.float32), np.zeros((0, 3), np.float32)
_NO_COVARS = np.zeros((0, 3, 3), np.float32)
_NO_ABSOLUTE = _NO_SLOPES = np.zeros((0, 2), np.float32)

# What backward reads is kept by ``save_for_backward`` alone: an array that shares the memory of a tensor would follow what is
# written into it in the meantime, and give a wrong gradient without a word, where torch refuses that.


def _shapes_as_arrays(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, bool]:
    """Return the inputs of both kernels of the projection that describe Gaussians; empty ones for what is not given."""
    return (
        _array(means),
        _NO_QUATS if quats is None else _array(quats),
        _NO_SCALES if scales is None else _array(scales),
        _NO_COVARS if covars is None else _array(covars),
        covars is not None,
    )


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None,
                opacities: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, near: float, far: float,
                eps2d: float) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        count = len(means)
        inputs = _shapes_as_arrays(means, quats, scales, covars)
        means2d, conics = torch.empty(count, 2), torch.empty(count, 3)
        depths, extents = torch.empty(count), torch.empty(count)
        radii = torch.empty(count, 2, dtype=torch.int32)
        parallel_for(
            kernels.project_forward, count, *inputs, _array(opacities), _array(viewmat), _array(K), width, height, np.float32(near),
            np.float32(far),
            np.float32(eps2d), means2d.numpy(), conics.numpy(), depths.numpy(), radii.numpy(), extents.numpy(),
        )  # fmt: skip
        ctx.mark_non_differentiable(radii, extents)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(means, quats, scales, covars, viewmat, K, radii, conics)
        ctx.size = width, height, np.float32(eps2d)
        return means2d, conics, depths, radii, extents

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_means2d: Tensor | None, grad_conics: Tensor | None, grad_depths: Tensor | None,
                 *_: Any) -> tuple[Tensor | None, ...]:  # fmt: skip
        given_means, given_quats, given_scales, given_covars, viewmat, K, radii, conics = ctx.saved_tensors
        inputs = _shapes_as_arrays(given_means, given_quats, given_scales, given_covars)
        means, quats, scales, covars, has_covars = inputs
        count = len(means)
        zeros = [
            torch.zeros(count, *shape) if gradient is None else gradient
            for gradient, shape in ((grad_means2d, (2,)), (grad_conics, (3,)), (grad_depths, ()))
        ]
        wants_camera = ctx.needs_input_grad[5] or ctx.needs_input_grad[6]
        grad_means, grad_quats = torch.empty(count, 3), torch.empty(len(quats), 4)
        grad_scales, grad_covars = torch.empty(len(scales), 3), torch.empty(len(covars), 3, 3)
        grad_camera = np.zeros((_CHUNKS, 16))
        parallel_for(
            kernels.project_backward, _CHUNKS, *inputs, _array(viewmat), _array(K), *ctx.size, radii.numpy(), _array(conics),
            *(_array(gradient) for gradient in zeros), grad_means.numpy(), grad_quats.numpy(), grad_scales.numpy(),
            grad_covars.numpy(), wants_camera, grad_camera,
        )  # fmt: skip
        grad_view = grad_K = None
        if wants_camera:
            camera = torch.from_numpy(grad_camera.sum(0)).to(torch.float32)
            grad_view, grad_K = torch.zeros(4, 4), torch.zeros(3, 3)
            grad_view[:3] = camera[:12].reshape(3, 4)
            grad_K[0, 0], grad_K[1, 1], grad_K[0, 2], grad_K[1, 2] = camera[12:]
        return (
            grad_means, None if has_covars else grad_quats, None if has_covars else grad_scales,
            grad_covars if has_covars else None, None, grad_view, grad_K, None, None, None, None, None,
        )  # fmt: skip


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, depths: Tensor,
                extents: Tensor, width: int, height: int, absolute: Tensor | None,
                slopes: Tensor | None) -> tuple[Tensor, Tensor]:  # fmt: skip
        lease = Lease()
        space = lease.workspace
        count, channels = features.shape
        xy, conic, opacity, feature, extent = map(_array, (means2d, conics, opacities, features, extents))
        slope = _NO_SLOPES if slopes is None else _array(slopes)
        sloped = (0,) * (slopes is not None)
        order = space.array("order", count, np.uint32)
        visible = tiles.sort_by_depth(
            _array(depths).view(np.uint32), extent, order,
            space.array("keys_a", count, np.uint32), space.array("keys_b", count, np.uint32),
            space.array("values", count, np.uint32),
        )  # fmt: skip
        sums = tiles.GEOMETRY + (0 if absolute is None else blending.ABSOLUTE) + blending.SLOPES * len(sloped)
        stride = -(-(sums + channels) // 16) * 16
        records = space.array("records", visible * stride, np.float32)
        chunks, tile_count = thread_count(), -(-width // tiles.TILE_WIDTH) * -(-height // tiles.TILE_HEIGHT)
        chunk_counts = space.array("chunk_counts", chunks * tile_count, np.int32).reshape(chunks, tile_count)
        columns, strip_counts = space.array("columns", visible, np.int32), np.empty(chunks, np.int64)
        instance_offsets = space.array("instance_offsets", visible + 2, np.int64)
        room = max(space.capacity("strips", np.int32) // (3 * chunks), 4 * visible // chunks, 1)
        while True:
            strips = space.array("strips", 3 * chunks * room, np.int32).reshape(chunks, room, 3)
            chunk_counts[:] = 0
            parallel_for(
                tiles.pack_and_cut, chunks, visible, order, xy, conic, opacity, feature, slope, width, height, records, stride,
                strips,
                strip_counts, columns, chunk_counts, instance_offsets,
            )  # fmt: skip
            if strip_counts.max() <= room:
                break
            room = int(strip_counts.max())
        total = tiles.prefix_sum(instance_offsets[1:], visible)
        if total > MAX_INSTANCES:
            raise ValueError(f"{total} pairs of a Gaussian and a tile are too many: at most {MAX_INSTANCES} fit")
        instance_offsets = instance_offsets[1:]
        tile_offsets = space.array("tile_offsets", tile_count + 1, np.int64)
        tiles.tile_ranges(chunk_counts, tile_offsets)
        instances = space.array("instances", 3 * total, np.int32).reshape(-1, 3)
        parallel_for(tiles.fill_tiles, chunks, visible, width, strips, columns, chunk_counts, instance_offsets, instances)

        image, transmittance = torch.empty(height, width, channels), torch.empty(height, width)
        tile_stops = space.array("tile_stops", tile_count, np.int64)
        parallel_for(
            blending.blend_forward, tile_count, width, height, records, stride, instances, tile_offsets, image.numpy(),
            transmittance.numpy(), tile_stops, sloped, (0,) * channels, pieces=_BLEND_PIECES,
        )  # fmt: skip
        ctx.lease, ctx.size, ctx.stride, ctx.visible, ctx.total = lease, (width, height), stride, visible, total
        ctx.tiles = records, instances, tile_offsets, tile_stops, order, instance_offsets
        ctx.save_for_backward(image, transmittance, conics, opacities, slopes)
        ctx.absolute, ctx.sloped = absolute, sloped
        ctx.set_materialize_grads(False)
        return image, 1 - transmittance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_alphas: Tensor | None) -> tuple[Tensor | None, ...]:
        image, transmittance, conics, opacities, slopes = ctx.saved_tensors
        conic, opacity, (width, height) = _array(conics), _array(opacities), ctx.size
        slope = _NO_SLOPES if slopes is None else _array(slopes)
        records, instances, tile_offsets, tile_stops, order, instance_offsets = ctx.tiles
        count, channels = len(opacity), image.shape[2]
        grad_image = torch.zeros_like(image) if grad_image is None else grad_image
        grad_alphas = torch.zeros_like(transmittance) if grad_alphas is None else grad_alphas
        out = ctx.lease.workspace.array("out", max(ctx.total, 1) * ctx.stride, np.float32)
        parallel_for(
            blending.blend_backward, len(tile_stops), width, height, records, ctx.stride, instances, tile_offsets, tile_stops,
            image.detach().numpy(), transmittance.numpy(), _array(grad_image), _array(grad_alphas), out,
            (0,) * (0 if ctx.absolute is None else blending.ABSOLUTE), ctx.sloped, (0,) * channels, pieces=_BLEND_PIECES,
        )  # fmt: skip
        grad_means2d, grad_conics = torch.zeros(count, 2), torch.zeros(count, 3)
        grad_opacities, grad_features = torch.zeros(count), torch.zeros(count, channels)
        grad_slopes = torch.zeros(len(slope), 2)
        parallel_for(
            blending.gather_gradients, ctx.visible, order, instance_offsets, out, ctx.stride, conic, opacity, slope,
            grad_means2d.numpy(), grad_conics.numpy(), grad_opacities.numpy(), grad_features.numpy(), grad_slopes.numpy(),
            _NO_ABSOLUTE if ctx.absolute is None else ctx.absolute.numpy(),
        )  # fmt: skip
        grad_sloped = grad_slopes if ctx.sloped else None
        return grad_means2d, grad_conics, grad_opacities, grad_features, None, None, None, None, None, grad_sloped


def project(*args: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """As ``reference.project``, and the squared sigmas [N] within which each Gaussian is drawn (0 where culled)."""
    result: tuple[Tensor, Tensor, Tensor, Tensor, Tensor] = _Project.apply(*args)
    return result


def blend(
    means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, depths: Tensor, extents: Tensor, width: int, height: int,
    absolute: Tensor | None, slopes: Tensor | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """As ``reference.blend``, with the extents of ``project`` in place of the radii.

    The kernels are compiled for every number of channels, which takes the longer the more there are. Absolute gradients are of
    all channels together, so they are not taken in pieces. Slopes are of channels in the first piece.
    """
    pieces = [
        _Blend.apply(means2d, conics, opacities, piece, depths, extents, width, height, absolute, None if k else slopes)
        for k, piece in enumerate(features.split(MAX_CHANNELS if absolute is None else features.shape[1], 1))
    ]
    if len(pieces) == 1:
        return pieces[0]
    return torch.cat([image for image, _ in pieces], 2), pieces[0][1]
