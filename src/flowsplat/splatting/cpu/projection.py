"""EWA projection and its gradient, one Gaussian at a time. Oracle: ``reference.project``.

With T = J V (rows a and b, the derivative of the pixel), the 2D covariance is T Sigma T^T + eps2d. Of quaternions and scales
Sigma = (R S)(R S)^T is never formed: the columns m = T R S are three arrows in the image, whose cross products give the
determinant (Lagrange's identity) and the inverse without the cancellation that long, thin Gaussians suffer in float32.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32

from flowsplat.common.kernels import inline, kernel, log
from flowsplat.splatting.rules import ALPHA_MIN, DETERMINANT_MAX, OPACITY_FLOOR, RADIUS_MAX, TANGENT_MARGIN

ONE, TWO, HALF, ZERO = np.float32(1), np.float32(2), np.float32(0.5), np.float32(0)
CLAMP_MARGIN, INVERSE_ALPHA_MIN = np.float32(TANGENT_MARGIN), np.float32(1 / ALPHA_MIN)
MIN_OPACITY, MAX_RADIUS = np.float32(OPACITY_FLOOR), np.float32(RADIUS_MAX)
MAX_DETERMINANT = np.float32(DETERMINANT_MAX)


@inline
def rotation(quats, i):
    """Entries of the rotation of quats[i], row by row, then the unit quaternion and the inverse of the length."""
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


@inline
def _load_covariance(covars, i):
    """Upper half xx, xy, xz, yy, yz, zz of a given covariance."""
    return (
        covars[i, 0, 0], HALF * (covars[i, 0, 1] + covars[i, 1, 0]), HALF * (covars[i, 0, 2] + covars[i, 2, 0]),
        covars[i, 1, 1], HALF * (covars[i, 1, 2] + covars[i, 2, 1]), covars[i, 2, 2],
    )  # fmt: skip


@inline
def _cross(x0, y0, x1, y1):
    return x0 * y1 - y0 * x1


@inline
def _flatten_given(covars, i, a0, a1, a2, b0, b1, b2, eps2d):
    """2D covariance (xx, xy, yy) and its determinant, of a given 3D covariance."""
    xx, xy, xz, yy, yz, zz = _load_covariance(covars, i)
    sa0, sa1, sa2 = xx * a0 + xy * a1 + xz * a2, xy * a0 + yy * a1 + yz * a2, xz * a0 + yz * a1 + zz * a2
    sb0, sb1, sb2 = xx * b0 + xy * b1 + xz * b2, xy * b0 + yy * b1 + yz * b2, xz * b0 + yz * b1 + zz * b2
    a, b, c = a0 * sa0 + a1 * sa1 + a2 * sa2 + eps2d, a0 * sb0 + a1 * sb1 + a2 * sb2, b0 * sb0 + b1 * sb1 + b2 * sb2 + eps2d
    return a, b, c, a * c - b * b


@inline
def _flatten(quats, scales, i, a0, a1, a2, b0, b1, b2, eps2d):
    """2D covariance (xx, xy, yy) and its determinant, of a rotation and scales."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, _, _, _, _, _ = rotation(quats, i)
    s0, s1, s2 = scales[i, 0], scales[i, 1], scales[i, 2]
    x0, y0 = (a0 * r00 + a1 * r10 + a2 * r20) * s0, (b0 * r00 + b1 * r10 + b2 * r20) * s0
    x1, y1 = (a0 * r01 + a1 * r11 + a2 * r21) * s1, (b0 * r01 + b1 * r11 + b2 * r21) * s1
    x2, y2 = (a0 * r02 + a1 * r12 + a2 * r22) * s2, (b0 * r02 + b1 * r12 + b2 * r22) * s2
    a, b, c = x0 * x0 + x1 * x1 + x2 * x2 + eps2d, x0 * y0 + x1 * y1 + x2 * y2, y0 * y0 + y1 * y1 + y2 * y2 + eps2d
    n01, n02, n12 = _cross(x0, y0, x1, y1), _cross(x0, y0, x2, y2), _cross(x1, y1, x2, y2)
    return a, b, c, n01 * n01 + n02 * n02 + n12 * n12 + eps2d * (a + c - eps2d)


@inline
def clamp(tangent, low, high):
    return min(max(tangent, low), high)


@kernel
def project_forward(
    begin, end, means, quats, scales, covars, has_covars, opacities, view, K, width, height, near, far, eps2d,
    means2d, conics, depths, radii, extents,
):  # fmt: skip
    """Fill means2d [N, 2], conics [N, 3], depths [N], radii [N, 2] and extents [N] (squared sigmas that are drawn; 0 = culled)."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    w, h = float32(width), float32(height)
    left, right = (-CLAMP_MARGIN * w - cx) / fx, (w + CLAMP_MARGIN * w - cx) / fx
    top, bottom = (-CLAMP_MARGIN * h - cy) / fy, (h + CLAMP_MARGIN * h - cy) / fy
    for i in range(begin, end):
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
        tx, ty = clamp(x * inverse, left, right), clamp(y * inverse, top, bottom)
        j00, j02, j11, j12 = fx * inverse, -fx * tx * inverse, fy * inverse, -fy * ty * inverse
        a0, a1, a2 = j00 * view[0, 0] + j02 * view[2, 0], j00 * view[0, 1] + j02 * view[2, 1], j00 * view[0, 2] + j02 * view[2, 2]
        b0, b1, b2 = j11 * view[1, 0] + j12 * view[2, 0], j11 * view[1, 1] + j12 * view[2, 1], j11 * view[1, 2] + j12 * view[2, 2]
        if has_covars:
            a, b, c, determinant = _flatten_given(covars, i, a0, a1, a2, b0, b1, b2, eps2d)
        else:
            a, b, c, determinant = _flatten(quats, scales, i, a0, a1, a2, b0, b1, b2, eps2d)
        good = inside and (determinant > ZERO) and (determinant < MAX_DETERMINANT)
        inverse_determinant = ONE / determinant if good else ONE
        conics[i, 0] = c * inverse_determinant
        conics[i, 1] = -b * inverse_determinant
        conics[i, 2] = a * inverse_determinant
        extent = TWO * log(max(opacities[i], MIN_OPACITY) * INVERSE_ALPHA_MIN)
        if good and extent > ZERO:
            half_x, half_y = max(np.ceil(math.sqrt(extent * a)), ONE), max(np.ceil(math.sqrt(extent * c)), ONE)
            if (u + half_x > ZERO) and (u - half_x < w) and (v + half_y > ZERO) and (v - half_y < h):
                extents[i] = extent
                radii[i, 0] = int(min(half_x, MAX_RADIUS))
                radii[i, 1] = int(min(half_y, MAX_RADIUS))


@kernel
def project_backward(
    begin, end, means, quats, scales, covars, has_covars, view, K, width, height, eps2d, radii, conics, grad_means2d, grad_conics,
    grad_depths,
    grad_means, grad_quats, grad_scales, grad_covars, wants_camera, grad_camera,
):  # fmt: skip
    """Gradients of everything; culled Gaussians get zeros. grad_camera is [chunks, 16], summed by the caller in order."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    w, h = float32(width), float32(height)
    left, right = (-CLAMP_MARGIN * w - cx) / fx, (w + CLAMP_MARGIN * w - cx) / fx
    top, bottom = (-CLAMP_MARGIN * h - cy) / fy, (h + CLAMP_MARGIN * h - cy) / fy
    v00, v01, v02, v10, v11, v12 = view[0, 0], view[0, 1], view[0, 2], view[1, 0], view[1, 1], view[1, 2]
    v20, v21, v22 = view[2, 0], view[2, 1], view[2, 2]
    count, chunks = means.shape[0], grad_camera.shape[0]
    for chunk in range(begin, end):
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
            tx, ty = clamp(ux, left, right), clamp(uy, top, bottom)
            j00, j02, j11, j12 = fx * inverse, -fx * tx * inverse, fy * inverse, -fy * ty * inverse
            a0, a1, a2 = j00 * v00 + j02 * v20, j00 * v01 + j02 * v21, j00 * v02 + j02 * v22
            b0, b1, b2 = j11 * v10 + j12 * v20, j11 * v11 + j12 * v21, j11 * v12 + j12 * v22
            ga, gb, gc = grad_conics[i, 0], HALF * grad_conics[i, 1], grad_conics[i, 2]
            if has_covars:
                da0, da1, da2, db0, db1, db2 = _store_covariance_gradient(
                    covars, conics, i, a0, a1, a2, b0, b1, b2, ga, gb, gc, grad_covars
                )
            else:
                da0, da1, da2, db0, db1, db2 = _rotation_and_scales_gradient(
                    quats, scales, conics, i, a0, a1, a2, b0, b1, b2, eps2d, ga, gb, gc, grad_quats, grad_scales
                )
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


@inline
def _store_covariance_gradient(covars, conics, i, a0, a1, a2, b0, b1, b2, ga, gb, gc, grad_covars):
    """Gradient of the rows a and b of T; fills that of the covariance. ga, gb, gc: of the conic, off-diagonal halved."""
    xx, xy, xz, yy, yz, zz = _load_covariance(covars, i)
    # conic = inverse of the 2D covariance: dCov = -conic dConic conic
    ca, cb, cc = conics[i, 0], conics[i, 1], conics[i, 2]
    m00, m01, m10, m11 = ga * ca + gb * cb, ga * cb + gb * cc, gb * ca + gc * cb, gb * cb + gc * cc
    g00, g01, g11 = -(ca * m00 + cb * m10), -(ca * m01 + cb * m11), -(cb * m01 + cc * m11)
    ta0, ta1, ta2 = g00 * a0 + g01 * b0, g00 * a1 + g01 * b1, g00 * a2 + g01 * b2
    tb0, tb1, tb2 = g01 * a0 + g11 * b0, g01 * a1 + g11 * b1, g01 * a2 + g11 * b2
    grad_covars[i, 0, 0], grad_covars[i, 1, 1], grad_covars[i, 2, 2] = a0 * ta0 + b0 * tb0, a1 * ta1 + b1 * tb1, a2 * ta2 + b2 * tb2
    grad_covars[i, 0, 1] = grad_covars[i, 1, 0] = a0 * ta1 + b0 * tb1
    grad_covars[i, 0, 2] = grad_covars[i, 2, 0] = a0 * ta2 + b0 * tb2
    grad_covars[i, 1, 2] = grad_covars[i, 2, 1] = a1 * ta2 + b1 * tb2
    return (
        TWO * (xx * ta0 + xy * ta1 + xz * ta2), TWO * (xy * ta0 + yy * ta1 + yz * ta2), TWO * (xz * ta0 + yz * ta1 + zz * ta2),
        TWO * (xx * tb0 + xy * tb1 + xz * tb2), TWO * (xy * tb0 + yy * tb1 + yz * tb2), TWO * (xz * tb0 + yz * tb1 + zz * tb2),
    )  # fmt: skip


@inline
def _arrow_gradient(ux, uy, s, crosses_x, crosses_y, eps2d, inverse_determinant, ca, cb, cc, ga, gb, gc):
    """Of one arrow m = s u: the gradient of m, and of s.

    conic u = (eps u + sum over the arrows k of (m_k x u) turned(m_k)) / determinant; crosses_x and crosses_y are that sum.
    """
    vx, vy = (eps2d * ux + crosses_x) * inverse_determinant, (eps2d * uy + crosses_y) * inverse_determinant
    wx, wy = ga * vx + gb * vy, gb * vx + gc * vy
    return -TWO * s * (ca * wx + cb * wy), -TWO * s * (cb * wx + cc * wy), -TWO * s * (vx * wx + vy * wy)


@inline
def _rotation_and_scales_gradient(quats, scales, conics, i, a0, a1, a2, b0, b1, b2, eps2d, ga, gb, gc, grad_quats, grad_scales):
    """Gradient of the rows a and b of T; fills those of quats and scales. ga, gb, gc: of the conic, off-diagonal halved."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, w, x, y, z, inverse = rotation(quats, i)
    s0, s1, s2 = scales[i, 0], scales[i, 1], scales[i, 2]
    ux0, uy0 = a0 * r00 + a1 * r10 + a2 * r20, b0 * r00 + b1 * r10 + b2 * r20
    ux1, uy1 = a0 * r01 + a1 * r11 + a2 * r21, b0 * r01 + b1 * r11 + b2 * r21
    ux2, uy2 = a0 * r02 + a1 * r12 + a2 * r22, b0 * r02 + b1 * r12 + b2 * r22
    x0, y0, x1, y1, x2, y2 = ux0 * s0, uy0 * s0, ux1 * s1, uy1 * s1, ux2 * s2, uy2 * s2
    n01, n02, n12 = _cross(x0, y0, x1, y1), _cross(x0, y0, x2, y2), _cross(x1, y1, x2, y2)
    trace = x0 * x0 + x1 * x1 + x2 * x2 + y0 * y0 + y1 * y1 + y2 * y2
    inverse_determinant = ONE / (n01 * n01 + n02 * n02 + n12 * n12 + eps2d * (trace + eps2d))
    ca, cb, cc = conics[i, 0], conics[i, 1], conics[i, 2]
    p10, p20 = _cross(x1, y1, ux0, uy0), _cross(x2, y2, ux0, uy0)
    p01, p21 = _cross(x0, y0, ux1, uy1), _cross(x2, y2, ux1, uy1)
    p02, p12 = _cross(x0, y0, ux2, uy2), _cross(x1, y1, ux2, uy2)
    dx0, dy0, grad_scales[i, 0] = _arrow_gradient(
        ux0, uy0, s0, -p10 * y1 - p20 * y2, p10 * x1 + p20 * x2, eps2d, inverse_determinant, ca, cb, cc, ga, gb, gc
    )
    dx1, dy1, grad_scales[i, 1] = _arrow_gradient(
        ux1, uy1, s1, -p01 * y0 - p21 * y2, p01 * x0 + p21 * x2, eps2d, inverse_determinant, ca, cb, cc, ga, gb, gc
    )
    dx2, dy2, grad_scales[i, 2] = _arrow_gradient(
        ux2, uy2, s2, -p02 * y0 - p12 * y1, p02 * x0 + p12 * x1, eps2d, inverse_determinant, ca, cb, cc, ga, gb, gc
    )
    dx0, dy0, dx1, dy1, dx2, dy2 = dx0 * s0, dy0 * s0, dx1 * s1, dy1 * s1, dx2 * s2, dy2 * s2
    grad_quats[i, 0], grad_quats[i, 1], grad_quats[i, 2], grad_quats[i, 3] = rotation_gradient(
        a0 * dx0 + b0 * dy0, a0 * dx1 + b0 * dy1, a0 * dx2 + b0 * dy2,
        a1 * dx0 + b1 * dy0, a1 * dx1 + b1 * dy1, a1 * dx2 + b1 * dy2,
        a2 * dx0 + b2 * dy0, a2 * dx1 + b2 * dy1, a2 * dx2 + b2 * dy2, w, x, y, z, inverse,
    )  # fmt: skip
    return (
        dx0 * r00 + dx1 * r01 + dx2 * r02, dx0 * r10 + dx1 * r11 + dx2 * r12, dx0 * r20 + dx1 * r21 + dx2 * r22,
        dy0 * r00 + dy1 * r01 + dy2 * r02, dy0 * r10 + dy1 * r11 + dy2 * r12, dy0 * r20 + dy1 * r21 + dy2 * r22,
    )  # fmt: skip


@inline
def rotation_gradient(d00, d01, d02, d10, d11, d12, d20, d21, d22, w, x, y, z, inverse):
    """Gradient of a quaternion from that of the entries of its rotation; the other arguments are what ``rotation`` gives."""
    gw = TWO * (-z * d01 + y * d02 + z * d10 - x * d12 - y * d20 + x * d21)
    gx = TWO * (y * d01 + z * d02 + y * d10 - TWO * x * d11 - w * d12 + z * d20 + w * d21 - TWO * x * d22)
    gy = TWO * (-TWO * y * d00 + x * d01 + w * d02 + x * d10 + z * d12 - w * d20 + z * d21 - TWO * y * d22)
    gz = TWO * (-TWO * z * d00 - w * d01 + x * d02 + w * d10 - TWO * z * d11 + y * d12 + x * d20 + y * d21)
    along = gw * w + gx * x + gy * y + gz * z
    return (gw - along * w) * inverse, (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse
