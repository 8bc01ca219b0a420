"""The features of color, depth and affine flow, and their gradient, in one sweep. Oracle: ``reference``.

With L = J R S of a Gaussian (J of the camera, R its rotation, S its scales; L' likewise at the other time), the matrix of
Affine flow (docs/method/flow.md) is B = (L' - L) L^T (L L^T + eps)^-1, because M Sigma = R' S S R^T.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.kernels import inline, kernel
from flowsplat.common.threads import parallel_for
from flowsplat.gaussians.slicing import Slice
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected
from flowsplat.splatting.cpu.footprint import NEAR_CLIP, footprint, footprint_gradient, tangent_limits
from flowsplat.splatting.cpu.projection import ONE, ZERO
from flowsplat.splatting.rules import EPS2D

CHANNELS = 10
"""Color 3, depth, flow at the center of the image 2, B by rows 4."""
CHUNKS = 64
"""Ranges into which Gaussians are cut, whatever the number of threads."""
BLUR_VARIANCE = np.float32(EPS2D)


@inline
def _products(L, later):
    """(L' - L) L^T by rows, and the inverse of L L^T + eps (xx, xy, yy)."""
    a = L[0, 0] * L[0, 0] + L[0, 1] * L[0, 1] + L[0, 2] * L[0, 2]
    b = L[0, 0] * L[1, 0] + L[0, 1] * L[1, 1] + L[0, 2] * L[1, 2]
    c = L[1, 0] * L[1, 0] + L[1, 1] * L[1, 1] + L[1, 2] * L[1, 2]
    z00 = later[0, 0] * L[0, 0] + later[0, 1] * L[0, 1] + later[0, 2] * L[0, 2] - a
    z01 = later[0, 0] * L[1, 0] + later[0, 1] * L[1, 1] + later[0, 2] * L[1, 2] - b
    z10 = later[1, 0] * L[0, 0] + later[1, 1] * L[0, 1] + later[1, 2] * L[0, 2] - b
    z11 = later[1, 0] * L[1, 0] + later[1, 1] * L[1, 1] + later[1, 2] * L[1, 2] - c
    a += BLUR_VARIANCE
    c += BLUR_VARIANCE
    inverse = ONE / (a * c - b * b)
    return z00, z01, z10, z11, c * inverse, -b * inverse, a * inverse


@kernel
def _forward(
    begin, end, colors, depths, means2d, means, quats, scales, next_means, next_quats, drawn, views, Ks, limits, center, features,
    hidden,
):  # fmt: skip
    """Fill features [A, 10 or 11]; hidden [1] becomes 1 where the other camera does not see a Gaussian that is drawn."""
    count = len(colors)
    for chunk in range(begin, end):
        turned, seen = np.empty((3, 3), np.float32), np.empty(12, np.float32)
        L, later = np.empty((2, 3), np.float32), np.empty((2, 3), np.float32)
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            for c in range(3):
                features[i, c] = colors[i, c]
            features[i, 3] = depths[i]
            footprint(means, quats, scales, i, views[0], Ks[0], limits[0], turned, L, seen)
            footprint(next_means, next_quats, scales, i, views[1], Ks[1], limits[1], turned, later, seen)
            front = seen[2] > NEAR_CLIP
            if front:
                z00, z01, z10, z11, xx, xy, yy = _products(L, later)
                b00, b01, b10, b11 = z00 * xx + z01 * xy, z00 * xy + z01 * yy, z10 * xx + z11 * xy, z10 * xy + z11 * yy
                cx, cy = means2d[i, 0] - center[0], means2d[i, 1] - center[1]
                features[i, 4] = Ks[1, 0, 0] * seen[0] * seen[5] + Ks[1, 0, 2] - means2d[i, 0] - b00 * cx - b01 * cy
                features[i, 5] = Ks[1, 1, 1] * seen[1] * seen[5] + Ks[1, 1, 2] - means2d[i, 1] - b10 * cx - b11 * cy
                features[i, 6], features[i, 7], features[i, 8], features[i, 9] = b00, b01, b10, b11
            else:
                for c in range(4, CHANNELS):
                    features[i, c] = ZERO
                if drawn[i, 0] > 0:
                    hidden[0] = 1
            if features.shape[1] > CHANNELS:
                features[i, CHANNELS] = ZERO if front else ONE


@kernel
def _backward(
    begin, end, gradient, means2d, means, quats, scales, next_means, next_quats, views, Ks, limits, center, d_colors, d_depths,
    d_means2d,
    d_means, d_quats, d_scales, d_next_means, d_next_quats,
):  # fmt: skip
    count = len(gradient)
    for chunk in range(begin, end):
        turned, next_turned = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
        L, later = np.empty((2, 3), np.float32), np.empty((2, 3), np.float32)
        seen, next_seen = np.empty(12, np.float32), np.empty(12, np.float32)
        d_L, d_later = np.empty((2, 3), np.float32), np.empty((2, 3), np.float32)
        for i in range(count * chunk // CHUNKS, count * (chunk + 1) // CHUNKS):
            for c in range(3):
                d_colors[i, c] = gradient[i, c]
                d_means[i, c] = ZERO
                d_next_means[i, c] = ZERO
                d_scales[i, c] = ZERO
            for c in range(4):
                d_quats[i, c] = ZERO
                d_next_quats[i, c] = ZERO
            d_depths[i] = gradient[i, 3]
            d_means2d[i, 0] = ZERO
            d_means2d[i, 1] = ZERO
            footprint(next_means, next_quats, scales, i, views[1], Ks[1], limits[1], next_turned, later, next_seen)
            if not next_seen[2] > NEAR_CLIP:
                continue
            footprint(means, quats, scales, i, views[0], Ks[0], limits[0], turned, L, seen)
            z00, z01, z10, z11, xx, xy, yy = _products(L, later)
            b00, b01, b10, b11 = z00 * xx + z01 * xy, z00 * xy + z01 * yy, z10 * xx + z11 * xy, z10 * xy + z11 * yy
            gu, gv = gradient[i, 4], gradient[i, 5]
            cx, cy = means2d[i, 0] - center[0], means2d[i, 1] - center[1]
            g00, g01 = gradient[i, 6] - gu * cx, gradient[i, 7] - gu * cy
            g10, g11 = gradient[i, 8] - gv * cx, gradient[i, 9] - gv * cy
            d_means2d[i, 0] = -gu - b00 * gu - b10 * gv
            d_means2d[i, 1] = -gv - b01 * gu - b11 * gv
            # B = Z A^-1 with Z = L' L^T - L L^T and A = L L^T + eps: dZ = H = dB A^-1 and dA = -B^T H.
            h00, h01, h10, h11 = g00 * xx + g01 * xy, g00 * xy + g01 * yy, g10 * xx + g11 * xy, g10 * xy + g11 * yy
            y00, y01 = -h00 - b00 * h00 - b10 * h10, -h01 - b00 * h01 - b10 * h11
            y10, y11 = -h10 - b01 * h00 - b11 * h10, -h11 - b01 * h01 - b11 * h11
            cross = y01 + y10
            for k in range(3):
                d_later[0, k] = h00 * L[0, k] + h01 * L[1, k]
                d_later[1, k] = h10 * L[0, k] + h11 * L[1, k]
                d_L[0, k] = h00 * later[0, k] + h10 * later[1, k] + (y00 + y00) * L[0, k] + cross * L[1, k]
                d_L[1, k] = h01 * later[0, k] + h11 * later[1, k] + cross * L[0, k] + (y11 + y11) * L[1, k]
            footprint_gradient(
                quats, scales, i, views[0], Ks[0], turned, seen, d_L, ZERO, ZERO, d_means[i], d_quats[i], d_scales[i]
            )
            footprint_gradient(
                next_quats, scales, i, views[1], Ks[1], next_turned, next_seen, d_later, gu, gv, d_next_means[i], d_next_quats[i],
                d_scales[i],
            )  # fmt: skip


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, colors: Tensor, depths: Tensor, means2d: Tensor, means: Tensor, quats: Tensor, scales: Tensor,
        next_means: Tensor, next_quats: Tensor, radii: Tensor, cameras: tuple[Camera, Camera],
    ) -> Tensor:  # fmt: skip
        given = (colors, depths, means2d, means, quats, scales, next_means, next_quats)
        inputs = [_array(tensor) for tensor in given]
        views, Ks = (np.stack(matrices).astype(np.float32) for matrices in zip(*((c.viewmat, c.K) for c in cameras), strict=True))
        width, height = cameras[0].width, cameras[0].height
        limits = np.stack([tangent_limits(K, width, height) for K in Ks])
        lens = views, Ks, limits, np.array([width / 2, height / 2], np.float32)
        drawn = radii.contiguous().numpy()
        features, hidden = torch.empty(len(colors), CHANNELS), np.zeros(1, np.uint8)
        parallel_for(_forward, CHUNKS, *inputs, drawn, *lens, features.numpy(), hidden)
        if hidden[0]:
            features = torch.empty(len(colors), CHANNELS + 1)
            parallel_for(_forward, CHUNKS, *inputs, drawn, *lens, features.numpy(), hidden)
        ctx.save_for_backward(*given[2:])
        ctx.lens = lens
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        count = len(gradient)
        results = [torch.empty(count, size) if size > 1 else torch.empty(count) for size in (3, 1, 2, 3, 4, 3, 3, 4)]
        inputs = [_array(tensor) for tensor in (gradient, *ctx.saved_tensors)]
        parallel_for(_backward, CHUNKS, *inputs, *ctx.lens, *(result.numpy() for result in results))
        return *results, None, None


def blend_affine(sliced: Slice, projected: Projected, camera: Camera, other: Camera) -> Tensor:
    """See ``api.blend_features``; from the Gaussians in ``camera`` to where they are next in the ``other`` one."""
    result: Tensor = _Features.apply(
        sliced.colors, projected.depths, projected.means2d, sliced.means, sliced.quats, sliced.scales, sliced.next_means,
        sliced.next_quats, projected.radii, (camera, other),
    )  # fmt: skip
    return result
