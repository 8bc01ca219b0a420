"""The footprint of a Gaussian in the image, J R S, and its gradient: for what varies inside a Gaussian."""

from __future__ import annotations

import numpy as np

from flowsplat.common.kernels import inline
from flowsplat.splatting.cpu.projection import CLAMP_MARGIN, ONE, ZERO, clamp, rotation, rotation_gradient
from flowsplat.splatting.rules import FOOTPRINT_NEAR_PLANE

NEAR_CLIP = np.float32(FOOTPRINT_NEAR_PLANE)


def tangent_limits(K: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return [4] float32 the tangents x / z and y / z, least and most, at which those of a Jacobian are clamped."""
    margin_x, margin_y = CLAMP_MARGIN * float(width), CLAMP_MARGIN * float(height)
    return np.array([
        (-margin_x - K[0, 2]) / K[0, 0], (width + margin_x - K[0, 2]) / K[0, 0],
        (-margin_y - K[1, 2]) / K[1, 1], (height + margin_y - K[1, 2]) / K[1, 1],
    ], np.float32)  # fmt: skip


@inline
def footprint(means, quats, scales, i, view, K, limits, turned, L, seen):
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
def footprint_gradient(quats, scales, i, view, K, turned, seen, d_L, gu, gv, d_mean, d_quat, d_scale):
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
