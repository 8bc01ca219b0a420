"""EWA projection and its gradient, one Gaussian at a time. Oracle: ``reference.project``.

The covariance is the common ground: it is given (``covars``), or made from ``quats`` and ``scales``, and its gradient goes
back the same way, so there is one kernel for both.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, njit, prange

from flowsplat.common.kernels import OPTIONS

ONE, TWO, HALF, ZERO = np.float32(1), np.float32(2), np.float32(0.5), np.float32(0)
MARGIN = np.float32(0.15)


@njit(inline="always", **OPTIONS)
def _rotation(quats, i):
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    inverse = ONE / math.sqrt(max(w * w + x * x + y * y + z * z, float32(1e-24)))
    w *= inverse
    x *= inverse
    y *= inverse
    z *= inverse
    return (
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
        w, x, y, z, inverse,
    )  # fmt: skip


@njit(inline="always", **OPTIONS)
def _covariance(quats, scales, covars, has_covars, i):
    """Upper half xx, xy, xz, yy, yz, zz."""
    if has_covars:
        return (
            covars[i, 0, 0], HALF * (covars[i, 0, 1] + covars[i, 1, 0]), HALF * (covars[i, 0, 2] + covars[i, 2, 0]),
            covars[i, 1, 1], HALF * (covars[i, 1, 2] + covars[i, 2, 1]), covars[i, 2, 2],
        )  # fmt: skip
    r00, r01, r02, r10, r11, r12, r20, r21, r22, _, _, _, _, _ = _rotation(quats, i)
    s0, s1, s2 = scales[i, 0] * scales[i, 0], scales[i, 1] * scales[i, 1], scales[i, 2] * scales[i, 2]
    return (
        r00 * r00 * s0 + r01 * r01 * s1 + r02 * r02 * s2,
        r00 * r10 * s0 + r01 * r11 * s1 + r02 * r12 * s2,
        r00 * r20 * s0 + r01 * r21 * s1 + r02 * r22 * s2,
        r10 * r10 * s0 + r11 * r11 * s1 + r12 * r12 * s2,
        r10 * r20 * s0 + r11 * r21 * s1 + r12 * r22 * s2,
        r20 * r20 * s0 + r21 * r21 * s1 + r22 * r22 * s2,
    )


@njit(inline="always", **OPTIONS)
def _clamped(tangent, low, high):
    return min(max(tangent, low), high)


@njit(parallel=True, **OPTIONS)
def project_forward(
    means, quats, scales, covars, has_covars, opacities, view, K, width, height, near, far, eps2d,
    means2d, conics, depths, radii, extents,
):  # fmt: skip
    """Fill means2d [N, 2], conics [N, 3], depths [N], radii [N, 2] and extents [N] (squared sigmas that are drawn; 0 = culled)."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    w, h = float32(width), float32(height)
    left, right = (-MARGIN * w - cx) / fx, (w + MARGIN * w - cx) / fx
    top, bottom = (-MARGIN * h - cy) / fy, (h + MARGIN * h - cy) / fy
    for i in prange(means.shape[0]):
        px, py, pz = means[i, 0], means[i, 1], means[i, 2]
        x = view[0, 0] * px + view[0, 1] * py + view[0, 2] * pz + view[0, 3]
        y = view[1, 0] * px + view[1, 1] * py + view[1, 2] * pz + view[1, 3]
        z = view[2, 0] * px + view[2, 1] * py + view[2, 2] * pz + view[2, 3]
        depths[i] = z
        extents[i] = ZERO
        radii[i, 0] = 0
        radii[i, 1] = 0
        inside = (z > near) and (z < far)
        inverse = ONE / z if inside else ONE
        u, v = fx * x * inverse + cx, fy * y * inverse + cy
        means2d[i, 0] = u
        means2d[i, 1] = v
        tx, ty = _clamped(x * inverse, left, right), _clamped(y * inverse, top, bottom)
        j00, j02, j11, j12 = fx * inverse, -fx * tx * inverse, fy * inverse, -fy * ty * inverse
        a0, a1, a2 = j00 * view[0, 0] + j02 * view[2, 0], j00 * view[0, 1] + j02 * view[2, 1], j00 * view[0, 2] + j02 * view[2, 2]
        b0, b1, b2 = j11 * view[1, 0] + j12 * view[2, 0], j11 * view[1, 1] + j12 * view[2, 1], j11 * view[1, 2] + j12 * view[2, 2]
        xx, xy, xz, yy, yz, zz = _covariance(quats, scales, covars, has_covars, i)
        sa0, sa1, sa2 = xx * a0 + xy * a1 + xz * a2, xy * a0 + yy * a1 + yz * a2, xz * a0 + yz * a1 + zz * a2
        sb0, sb1, sb2 = xx * b0 + xy * b1 + xz * b2, xy * b0 + yy * b1 + yz * b2, xz * b0 + yz * b1 + zz * b2
        a = a0 * sa0 + a1 * sa1 + a2 * sa2 + eps2d
        b = a0 * sb0 + a1 * sb1 + a2 * sb2
        c = b0 * sb0 + b1 * sb1 + b2 * sb2 + eps2d
        determinant = a * c - b * b
        good = inside and (determinant > ZERO) and (determinant < float32(1e30))
        inverse_determinant = ONE / determinant if good else ONE
        conics[i, 0] = c * inverse_determinant
        conics[i, 1] = -b * inverse_determinant
        conics[i, 2] = a * inverse_determinant
        extent = TWO * math.log(max(opacities[i], float32(1e-12)) * float32(255))
        if good and extent > ZERO:
            half_x, half_y = math.sqrt(extent * a), math.sqrt(extent * c)
            if (u + half_x > ZERO) and (u - half_x < w) and (v + half_y > ZERO) and (v - half_y < h):
                extents[i] = extent
                radii[i, 0] = int(min(max(math.ceil(half_x), ONE), float32(1e6)))
                radii[i, 1] = int(min(max(math.ceil(half_y), ONE), float32(1e6)))


@njit(parallel=True, **OPTIONS)
def project_backward(
    means, quats, scales, covars, has_covars, view, K, width, height, radii, conics, grad_means2d, grad_conics, grad_depths,
    grad_means, grad_quats, grad_scales, grad_covars, wants_camera, grad_camera,
):  # fmt: skip
    """Gradients of everything; culled Gaussians get zeros. grad_camera is [chunks, 16], summed by the caller in order."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    w, h = float32(width), float32(height)
    left, right = (-MARGIN * w - cx) / fx, (w + MARGIN * w - cx) / fx
    top, bottom = (-MARGIN * h - cy) / fy, (h + MARGIN * h - cy) / fy
    v00, v01, v02, v10, v11, v12 = view[0, 0], view[0, 1], view[0, 2], view[1, 0], view[1, 1], view[1, 2]
    v20, v21, v22 = view[2, 0], view[2, 1], view[2, 2]
    count, chunks = means.shape[0], grad_camera.shape[0]
    for chunk in prange(chunks):
        camera = np.zeros(16, np.float64)
        for i in range(count * chunk // chunks, count * (chunk + 1) // chunks):
            if radii[i, 0] == 0:
                for k in range(3):
                    grad_means[i, k] = ZERO
                if has_covars:
                    for k in range(3):
                        for m in range(3):
                            grad_covars[i, k, m] = ZERO
                else:
                    for k in range(3):
                        grad_scales[i, k] = ZERO
                    for k in range(4):
                        grad_quats[i, k] = ZERO
                continue
            px, py, pz = means[i, 0], means[i, 1], means[i, 2]
            x = v00 * px + v01 * py + v02 * pz + view[0, 3]
            y = v10 * px + v11 * py + v12 * pz + view[1, 3]
            z = v20 * px + v21 * py + v22 * pz + view[2, 3]
            inverse = ONE / z
            ux, uy = x * inverse, y * inverse
            tx, ty = _clamped(ux, left, right), _clamped(uy, top, bottom)
            j00, j02, j11, j12 = fx * inverse, -fx * tx * inverse, fy * inverse, -fy * ty * inverse
            a0, a1, a2 = j00 * v00 + j02 * v20, j00 * v01 + j02 * v21, j00 * v02 + j02 * v22
            b0, b1, b2 = j11 * v10 + j12 * v20, j11 * v11 + j12 * v21, j11 * v12 + j12 * v22
            xx, xy, xz, yy, yz, zz = _covariance(quats, scales, covars, has_covars, i)
            # conic = inverse of the 2D covariance: dCov = -conic dConic conic (symmetric; the off-diagonal counts twice)
            ca, cb, cc = conics[i, 0], conics[i, 1], conics[i, 2]
            ga, gb, gc = grad_conics[i, 0], HALF * grad_conics[i, 1], grad_conics[i, 2]
            m00, m01, m10, m11 = ga * ca + gb * cb, ga * cb + gb * cc, gb * ca + gc * cb, gb * cb + gc * cc
            g00, g01, g11 = -(ca * m00 + cb * m10), -(ca * m01 + cb * m11), -(cb * m01 + cc * m11)
            # 2D covariance = T Sigma T^T with rows a, b of T
            ta0, ta1, ta2 = g00 * a0 + g01 * b0, g00 * a1 + g01 * b1, g00 * a2 + g01 * b2
            tb0, tb1, tb2 = g01 * a0 + g11 * b0, g01 * a1 + g11 * b1, g01 * a2 + g11 * b2
            s00, s01, s02 = a0 * ta0 + b0 * tb0, a0 * ta1 + b0 * tb1, a0 * ta2 + b0 * tb2
            s11, s12, s22 = a1 * ta1 + b1 * tb1, a1 * ta2 + b1 * tb2, a2 * ta2 + b2 * tb2
            da0, db0 = TWO * (xx * ta0 + xy * ta1 + xz * ta2), TWO * (xx * tb0 + xy * tb1 + xz * tb2)
            da1, db1 = TWO * (xy * ta0 + yy * ta1 + yz * ta2), TWO * (xy * tb0 + yy * tb1 + yz * tb2)
            da2, db2 = TWO * (xz * ta0 + yz * ta1 + zz * ta2), TWO * (xz * tb0 + yz * tb1 + zz * tb2)
            if has_covars:
                grad_covars[i, 0, 0] = s00
                grad_covars[i, 0, 1] = s01
                grad_covars[i, 0, 2] = s02
                grad_covars[i, 1, 0] = s01
                grad_covars[i, 1, 1] = s11
                grad_covars[i, 1, 2] = s12
                grad_covars[i, 2, 0] = s02
                grad_covars[i, 2, 1] = s12
                grad_covars[i, 2, 2] = s22
            else:
                _quaternion_gradient(quats, scales, i, s00, s01, s02, s11, s12, s22, grad_quats, grad_scales)
            # T = J V
            dj00, dj02 = da0 * v00 + da1 * v01 + da2 * v02, da0 * v20 + da1 * v21 + da2 * v22
            dj11, dj12 = db0 * v10 + db1 * v11 + db2 * v12, db0 * v20 + db1 * v21 + db2 * v22
            gu, gv = grad_means2d[i, 0], grad_means2d[i, 1]
            dtx, dty = -dj02 * fx * inverse, -dj12 * fy * inverse
            free_x, free_y = tx == ux, ty == uy
            dux = gu * fx + (dtx if free_x else ZERO)
            duy = gv * fy + (dty if free_y else ZERO)
            dinverse = dj00 * fx - dj02 * fx * tx + dj11 * fy - dj12 * fy * ty + dux * x + duy * y
            dx, dy, dz = dux * inverse, duy * inverse, -dinverse * inverse * inverse + grad_depths[i]
            grad_means[i, 0] = v00 * dx + v10 * dy + v20 * dz
            grad_means[i, 1] = v01 * dx + v11 * dy + v21 * dz
            grad_means[i, 2] = v02 * dx + v12 * dy + v22 * dz
            if wants_camera:
                camera[0] += dx * px + j00 * da0
                camera[1] += dx * py + j00 * da1
                camera[2] += dx * pz + j00 * da2
                camera[3] += dx
                camera[4] += dy * px + j11 * db0
                camera[5] += dy * py + j11 * db1
                camera[6] += dy * pz + j11 * db2
                camera[7] += dy
                camera[8] += dz * px + j02 * da0 + j12 * db0
                camera[9] += dz * py + j02 * da1 + j12 * db1
                camera[10] += dz * pz + j02 * da2 + j12 * db2
                camera[11] += dz
                camera[12] += gu * ux + dj00 * inverse - dj02 * tx * inverse - (ZERO if free_x else dtx * tx / fx)
                camera[13] += gv * uy + dj11 * inverse - dj12 * ty * inverse - (ZERO if free_y else dty * ty / fy)
                camera[14] += gu - (ZERO if free_x else dtx / fx)
                camera[15] += gv - (ZERO if free_y else dty / fy)
        for k in range(16):
            grad_camera[chunk, k] = camera[k]


@njit(inline="always", **OPTIONS)
def _quaternion_gradient(quats, scales, i, s00, s01, s02, s11, s12, s22, grad_quats, grad_scales):
    """Sigma = (R S)(R S)^T, so dM = 2 dSigma M with M = R S (d holds half of it); then R(q / |q|)."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, w, x, y, z, inverse = _rotation(quats, i)
    s0, s1, s2 = scales[i, 0], scales[i, 1], scales[i, 2]
    d00, d01, d02 = s00 * r00 + s01 * r10 + s02 * r20, s00 * r01 + s01 * r11 + s02 * r21, s00 * r02 + s01 * r12 + s02 * r22
    d10, d11, d12 = s01 * r00 + s11 * r10 + s12 * r20, s01 * r01 + s11 * r11 + s12 * r21, s01 * r02 + s11 * r12 + s12 * r22
    d20, d21, d22 = s02 * r00 + s12 * r10 + s22 * r20, s02 * r01 + s12 * r11 + s22 * r21, s02 * r02 + s12 * r12 + s22 * r22
    grad_scales[i, 0] = TWO * s0 * (d00 * r00 + d10 * r10 + d20 * r20)
    grad_scales[i, 1] = TWO * s1 * (d01 * r01 + d11 * r11 + d21 * r21)
    grad_scales[i, 2] = TWO * s2 * (d02 * r02 + d12 * r12 + d22 * r22)
    s0, s1, s2 = TWO * s0 * s0, TWO * s1 * s1, TWO * s2 * s2
    d00, d10, d20 = d00 * s0, d10 * s0, d20 * s0
    d01, d11, d21 = d01 * s1, d11 * s1, d21 * s1
    d02, d12, d22 = d02 * s2, d12 * s2, d22 * s2
    gw = TWO * (-z * d01 + y * d02 + z * d10 - x * d12 - y * d20 + x * d21)
    gx = TWO * (y * d01 + z * d02 + y * d10 - TWO * x * d11 - w * d12 + z * d20 + w * d21 - TWO * x * d22)
    gy = TWO * (-TWO * y * d00 + x * d01 + w * d02 + x * d10 + z * d12 - w * d20 + z * d21 - TWO * y * d22)
    gz = TWO * (-TWO * z * d00 - w * d01 + x * d02 + w * d10 - TWO * z * d11 + y * d12 + x * d20 + y * d21)
    along = gw * w + gx * x + gy * y + gz * z
    grad_quats[i, 0] = (gw - along * w) * inverse
    grad_quats[i, 1] = (gx - along * x) * inverse
    grad_quats[i, 2] = (gy - along * y) * inverse
    grad_quats[i, 3] = (gz - along * z) * inverse
