"""The features of color, depth and affine flow, and their gradient, in one sweep. Oracle: ``reference``.

With L = J R S of a Gaussian (J of the camera, R its rotation, S its scales; L' likewise at the other time), the matrix of
Affine flow (docs/method.md) is B = (L' - L) L^T (L L^T + eps)^-1, because M Sigma = R' S S R^T.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.kernels import inline, kernel
from flowsplat.common.threads import parallel_for
from flowsplat.gaussians.flow.reference import FLOW_NEAR_PLANE
from flowsplat.gaussians.slicing import Slice
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected
from flowsplat.splatting.cpu.projection import CLAMP_MARGIN, ONE, ZERO, clamp, rotation, rotation_gradient
from flowsplat.splatting.rules import EPS2D

CHANNELS = 10
"""Color 3, depth, flow at the center of the image 2, B by rows 4."""
CHUNKS = 64
"""Ranges into which Gaussians are cut, whatever the number of threads."""
NEAR_CLIP, BLUR_VARIANCE = np.float32(FLOW_NEAR_PLANE), np.float32(EPS2D)


@inline
def _footprint(means, quats, scales, i, view, K, limits, turned, L, seen):
    """Fill turned [3, 3] = R S, L [2, 3] = J R S and seen: the point in camera axes, its clamped tangents, 1 / z and J's rows."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, _, _, _, _, _ = rotation(quats, i)
    s0, s1, s2 = scales[i, 0], scales[i, 1], scales[i, 2]
    turned[0, 0], turned[0, 1], turned[0, 2] = r00 * s0, r01 * s1, r02 * s2
    turned[1, 0], turned[1, 1], turned[1, 2] = r10 * s0, r11 * s1, r12 * s2
    turned[2, 0], turned[2, 1], turned[2, 2] = r20 * s0, r21 * s1, r22 * s2
    px, py, pz = means[i, 0], means[i, 1], means[i, 2]
    x = view[0, 0] * px + view[0, 1] * py + view[0, 2] * pz + view[0, 3]
    y = view[1, 0] * px + view[1, 1] * py + view[1, 2] * pz + view[1, 3]
    z = view[2, 0] * px + view[2, 1] * py + view[2, 2] * pz + view[2, 3]
    inverse = ONE / max(z, NEAR_CLIP)
    tx, ty = clamp(x * inverse, limits[0], limits[1]), clamp(y * inverse, limits[2], limits[3])
    seen[0], seen[1], seen[2], seen[3], seen[4], seen[5] = x, y, z, tx, ty, inverse
    for d in range(3):
        a = K[0, 0] * inverse * (view[0, d] - tx * view[2, d])
        b = K[1, 1] * inverse * (view[1, d] - ty * view[2, d])
        seen[6 + d], seen[9 + d] = a, b
    for k in range(3):
        L[0, k] = seen[6] * turned[0, k] + seen[7] * turned[1, k] + seen[8] * turned[2, k]
        L[1, k] = seen[9] * turned[0, k] + seen[10] * turned[1, k] + seen[11] * turned[2, k]


@inline
def _footprint_gradient(quats, scales, i, view, K, turned, seen, d_L, gu, gv, d_mean, d_quat, d_scale):
    """Fill d_mean [3] and d_quat [4] and add to d_scale [3], from d_L [2, 3] and the gradient gu, gv of the pixel."""
    fx, fy = K[0, 0], K[1, 1]
    x, y, z, tx, ty, inverse = seen[0], seen[1], seen[2], seen[3], seen[4], seen[5]
    dj00, dj02, dj11, dj12 = ZERO, ZERO, ZERO, ZERO
    for r in range(3):
        a = turned[r, 0] * d_L[0, 0] + turned[r, 1] * d_L[0, 1] + turned[r, 2] * d_L[0, 2]
        b = turned[r, 0] * d_L[1, 0] + turned[r, 1] * d_L[1, 1] + turned[r, 2] * d_L[1, 2]
        dj00 += a * view[0, r]
        dj02 += a * view[2, r]
        dj11 += b * view[1, r]
        dj12 += b * view[2, r]
    dux = gu * fx - (dj02 * fx * inverse if tx == x * inverse else ZERO)
    duy = gv * fy - (dj12 * fy * inverse if ty == y * inverse else ZERO)
    d_inverse = fx * (dj00 - dj02 * tx) + fy * (dj11 - dj12 * ty) + dux * x + duy * y
    dx, dy, dz = dux * inverse, duy * inverse, -d_inverse * inverse * inverse if z > NEAR_CLIP else ZERO
    for d in range(3):
        d_mean[d] = view[0, d] * dx + view[1, d] * dy + view[2, d] * dz
    r00, r01, r02, r10, r11, r12, r20, r21, r22, qw, qx, qy, qz, length = rotation(quats, i)
    a0, a1, a2, b0, b1, b2 = seen[6], seen[7], seen[8], seen[9], seen[10], seen[11]
    p0, p1, p2, q0, q1, q2 = d_L[0, 0], d_L[0, 1], d_L[0, 2], d_L[1, 0], d_L[1, 1], d_L[1, 2]
    # The gradient of R S is J^T d_L.
    w00, w01, w02 = a0 * p0 + b0 * q0, a0 * p1 + b0 * q1, a0 * p2 + b0 * q2
    w10, w11, w12 = a1 * p0 + b1 * q0, a1 * p1 + b1 * q1, a1 * p2 + b1 * q2
    w20, w21, w22 = a2 * p0 + b2 * q0, a2 * p1 + b2 * q1, a2 * p2 + b2 * q2
    d_scale[0] += r00 * w00 + r10 * w10 + r20 * w20
    d_scale[1] += r01 * w01 + r11 * w11 + r21 * w21
    d_scale[2] += r02 * w02 + r12 * w12 + r22 * w22
    s0, s1, s2 = scales[i, 0], scales[i, 1], scales[i, 2]
    d_quat[0], d_quat[1], d_quat[2], d_quat[3] = rotation_gradient(
        w00 * s0, w01 * s1, w02 * s2, w10 * s0, w11 * s1, w12 * s2, w20 * s0, w21 * s1, w22 * s2, qw, qx, qy, qz, length
    )


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
            _footprint(means, quats, scales, i, views[0], Ks[0], limits[0], turned, L, seen)
            _footprint(next_means, next_quats, scales, i, views[1], Ks[1], limits[1], turned, later, seen)
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
            _footprint(next_means, next_quats, scales, i, views[1], Ks[1], limits[1], next_turned, later, next_seen)
            if not next_seen[2] > NEAR_CLIP:
                continue
            _footprint(means, quats, scales, i, views[0], Ks[0], limits[0], turned, L, seen)
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
            _footprint_gradient(
                quats, scales, i, views[0], Ks[0], turned, seen, d_L, ZERO, ZERO, d_means[i], d_quats[i], d_scales[i]
            )
            _footprint_gradient(
                next_quats, scales, i, views[1], Ks[1], next_turned, next_seen, d_later, gu, gv, d_next_means[i], d_next_quats[i],
                d_scales[i],
            )  # fmt: skip


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, colors: Tensor, depths: Tensor, means2d: Tensor, means: Tensor, quats: Tensor, scales: Tensor,
        next_means: Tensor, next_quats: Tensor, radii: Tensor, cameras: tuple[Camera, Camera],
    ) -> Tensor:  # fmt: skip
        given = (colors, depths, means2d, means, quats, scales, next_means, next_quats)
        inputs = [tensor.detach().contiguous().numpy() for tensor in given]
        views, Ks = (np.stack(matrices).astype(np.float32) for matrices in zip(*((c.viewmat, c.K) for c in cameras), strict=True))
        width, height = float(cameras[0].width), float(cameras[0].height)
        limits = np.array([
            [(-CLAMP_MARGIN * width - K[0, 2]) / K[0, 0], (width + CLAMP_MARGIN * width - K[0, 2]) / K[0, 0],
             (-CLAMP_MARGIN * height - K[1, 2]) / K[1, 1], (height + CLAMP_MARGIN * height - K[1, 2]) / K[1, 1]]
            for K in Ks
        ], np.float32)  # fmt: skip
        lens = views, Ks, limits, np.array([width / 2, height / 2], np.float32)
        drawn = radii.contiguous().numpy()
        features, hidden = torch.empty(len(colors), CHANNELS), np.zeros(1, np.uint8)
        parallel_for(_forward, CHUNKS, *inputs, drawn, *lens, features.numpy(), hidden)
        if hidden[0]:
            features = torch.empty(len(colors), CHANNELS + 1)
            parallel_for(_forward, CHUNKS, *inputs, drawn, *lens, features.numpy(), hidden)
        ctx.inputs = *inputs[2:], *lens
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        count = len(gradient)
        results = [torch.empty(count, size) if size > 1 else torch.empty(count) for size in (3, 1, 2, 3, 4, 3, 3, 4)]
        parallel_for(_backward, CHUNKS, gradient.contiguous().numpy(), *ctx.inputs, *(result.numpy() for result in results))
        return *results, None, None


def blend_affine(sliced: Slice, projected: Projected, camera: Camera, other: Camera) -> Tensor:
    """See ``api.blend_features``; from the Gaussians in ``camera`` to where they are next in the ``other`` one."""
    result: Tensor = _Features.apply(
        sliced.colors, projected.depths, projected.means2d, sliced.means, sliced.quats, sliced.scales, sliced.next_means,
        sliced.next_quats, projected.radii, (camera, other),
    )  # fmt: skip
    return result
