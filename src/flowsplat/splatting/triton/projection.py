"""EWA projection and its gradient, a block of Gaussians at a time. Oracle: ``reference.project``; formulas: ``cpu.projection``.

With T = J V (rows a and b, the derivative of the pixel), the 2D covariance is T Sigma T^T + eps2d. Of quaternions and scales
Sigma = (R S)(R S)^T is never formed: the columns m = T R S are three arrows in the image, whose cross products give the
determinant (Lagrange's identity) and the inverse without the cancellation that long, thin Gaussians suffer in float32.
"""

from __future__ import annotations

import triton
import triton.language as tl

from flowsplat.splatting.rules import ALPHA_MIN, DETERMINANT_MAX, OPACITY_FLOOR, RADIUS_MAX, TANGENT_MARGIN

CLAMP_MARGIN, INVERSE_ALPHA_MIN = tl.constexpr(TANGENT_MARGIN), tl.constexpr(1 / ALPHA_MIN)
MIN_OPACITY, MAX_RADIUS = tl.constexpr(OPACITY_FLOOR), tl.constexpr(RADIUS_MAX)
MAX_DETERMINANT = tl.constexpr(DETERMINANT_MAX)
CAMERA = 16
"""Entries of a camera's gradient: twelve of viewmat, then fx, fy, cx, cy."""


@triton.jit
def _view(view):
    """The twelve entries of viewmat [4, 4] that are read."""
    return (
        tl.load(view), tl.load(view + 1), tl.load(view + 2), tl.load(view + 3),
        tl.load(view + 4), tl.load(view + 5), tl.load(view + 6), tl.load(view + 7),
        tl.load(view + 8), tl.load(view + 9), tl.load(view + 10), tl.load(view + 11),
    )  # fmt: skip


@triton.jit
def _intrinsics(K, w, h):
    """fx, fy, cx, cy of K [3, 3], and the tangents beyond which the Jacobian is clamped."""
    fx, cx, fy, cy = tl.load(K), tl.load(K + 2), tl.load(K + 4), tl.load(K + 5)
    margin_x, margin_y = w * CLAMP_MARGIN, h * CLAMP_MARGIN
    left, right = (-margin_x - cx) / fx, (w + margin_x - cx) / fx
    top, bottom = (-margin_y - cy) / fy, (h + margin_y - cy) / fy
    return fx, fy, cx, cy, left, right, top, bottom


@triton.jit
def _clamp(tangent, low, high):
    return tl.minimum(tl.maximum(tangent, low), high)


@triton.jit
def rotation(quats, i, live):
    """Entries of the rotation of quats[i], row by row, then the unit quaternion and the inverse of the length."""
    w = tl.load(quats + 4 * i, mask=live, other=1.0)
    x = tl.load(quats + 4 * i + 1, mask=live, other=0.0)
    y = tl.load(quats + 4 * i + 2, mask=live, other=0.0)
    z = tl.load(quats + 4 * i + 3, mask=live, other=0.0)
    inverse = 1.0 / tl.sqrt(tl.maximum(w * w + x * x + y * y + z * z, 1e-24))
    w *= inverse
    x *= inverse
    y *= inverse
    z *= inverse
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        w, x, y, z, inverse,
    )  # fmt: skip


@triton.jit
def _load_covariance(covars, i, live):
    """Upper half xx, xy, xz, yy, yz, zz of a given covariance."""
    o = covars + 9 * i
    xx = tl.load(o, mask=live, other=1.0)
    xy = 0.5 * (tl.load(o + 1, mask=live, other=0.0) + tl.load(o + 3, mask=live, other=0.0))
    xz = 0.5 * (tl.load(o + 2, mask=live, other=0.0) + tl.load(o + 6, mask=live, other=0.0))
    yy = tl.load(o + 4, mask=live, other=1.0)
    yz = 0.5 * (tl.load(o + 5, mask=live, other=0.0) + tl.load(o + 7, mask=live, other=0.0))
    zz = tl.load(o + 8, mask=live, other=1.0)
    return xx, xy, xz, yy, yz, zz


@triton.jit
def _cross(x0, y0, x1, y1):
    return x0 * y1 - y0 * x1


@triton.jit
def _flatten_given(covars, i, live, a0, a1, a2, b0, b1, b2, eps2d):
    """2D covariance (xx, xy, yy) and its determinant, of a given 3D covariance."""
    xx, xy, xz, yy, yz, zz = _load_covariance(covars, i, live)
    sa0, sa1, sa2 = xx * a0 + xy * a1 + xz * a2, xy * a0 + yy * a1 + yz * a2, xz * a0 + yz * a1 + zz * a2
    sb0, sb1, sb2 = xx * b0 + xy * b1 + xz * b2, xy * b0 + yy * b1 + yz * b2, xz * b0 + yz * b1 + zz * b2
    a, b, c = a0 * sa0 + a1 * sa1 + a2 * sa2 + eps2d, a0 * sb0 + a1 * sb1 + a2 * sb2, b0 * sb0 + b1 * sb1 + b2 * sb2 + eps2d
    return a, b, c, a * c - b * b


@triton.jit
def _flatten(quats, scales, i, live, a0, a1, a2, b0, b1, b2, eps2d):
    """2D covariance (xx, xy, yy) and its determinant, of a rotation and scales."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, _w, _x, _y, _z, _inverse = rotation(quats, i, live)
    s0 = tl.load(scales + 3 * i, mask=live, other=1.0)
    s1 = tl.load(scales + 3 * i + 1, mask=live, other=1.0)
    s2 = tl.load(scales + 3 * i + 2, mask=live, other=1.0)
    x0, y0 = (a0 * r00 + a1 * r10 + a2 * r20) * s0, (b0 * r00 + b1 * r10 + b2 * r20) * s0
    x1, y1 = (a0 * r01 + a1 * r11 + a2 * r21) * s1, (b0 * r01 + b1 * r11 + b2 * r21) * s1
    x2, y2 = (a0 * r02 + a1 * r12 + a2 * r22) * s2, (b0 * r02 + b1 * r12 + b2 * r22) * s2
    a, b, c = x0 * x0 + x1 * x1 + x2 * x2 + eps2d, x0 * y0 + x1 * y1 + x2 * y2, y0 * y0 + y1 * y1 + y2 * y2 + eps2d
    n01, n02, n12 = _cross(x0, y0, x1, y1), _cross(x0, y0, x2, y2), _cross(x1, y1, x2, y2)
    return a, b, c, n01 * n01 + n02 * n02 + n12 * n12 + eps2d * (a + c - eps2d)


@triton.jit(do_not_specialize=["count", "width", "height"])
def project_forward(
    means, quats, scales, covars, opacities, view, K, means2d, conics, depths, radii, extents,
    count, width, height, near, far, eps2d, HAS_COVARS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Fill means2d [N, 2], conics [N, 3], depths [N], radii [N, 2] and extents [N] (squared sigmas that are drawn; 0 = culled)."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    w, h = width.to(tl.float32), height.to(tl.float32)
    v00, v01, v02, v03, v10, v11, v12, v13, v20, v21, v22, v23 = _view(view)
    fx, fy, cx, cy, left, right, top, bottom = _intrinsics(K, w, h)
    px = tl.load(means + 3 * i, mask=live, other=0.0)
    py = tl.load(means + 3 * i + 1, mask=live, other=0.0)
    pz = tl.load(means + 3 * i + 2, mask=live, other=0.0)
    x = v00 * px + v01 * py + v02 * pz + v03
    y = v10 * px + v11 * py + v12 * pz + v13
    z = v20 * px + v21 * py + v22 * pz + v23
    inside = (z > near) & (z < far)
    inverse = 1.0 / tl.where(inside, z, 1.0)
    u, v = fx * x * inverse + cx, fy * y * inverse + cy
    tx, ty = _clamp(x * inverse, left, right), _clamp(y * inverse, top, bottom)
    j00, j02, j11, j12 = fx * inverse, -fx * tx * inverse, fy * inverse, -fy * ty * inverse
    a0, a1, a2 = j00 * v00 + j02 * v20, j00 * v01 + j02 * v21, j00 * v02 + j02 * v22
    b0, b1, b2 = j11 * v10 + j12 * v20, j11 * v11 + j12 * v21, j11 * v12 + j12 * v22
    if HAS_COVARS:
        a, b, c, determinant = _flatten_given(covars, i, live, a0, a1, a2, b0, b1, b2, eps2d)
    else:
        a, b, c, determinant = _flatten(quats, scales, i, live, a0, a1, a2, b0, b1, b2, eps2d)
    good = inside & (determinant > 0) & (determinant < MAX_DETERMINANT)
    inverse_determinant = 1.0 / tl.where(good, determinant, 1.0)
    opacity = tl.load(opacities + i, mask=live, other=0.0)
    extent = 2 * tl.log(tl.maximum(opacity, MIN_OPACITY) * INVERSE_ALPHA_MIN)
    good = good & (extent > 0)
    half_x = tl.maximum(tl.ceil(tl.sqrt(tl.where(good, extent * a, 0.0))), 1.0)
    half_y = tl.maximum(tl.ceil(tl.sqrt(tl.where(good, extent * c, 0.0))), 1.0)
    good = good & (u + half_x > 0) & (u - half_x < w) & (v + half_y > 0) & (v - half_y < h)
    tl.store(means2d + 2 * i, u, mask=live)
    tl.store(means2d + 2 * i + 1, v, mask=live)
    tl.store(conics + 3 * i, c * inverse_determinant, mask=live)
    tl.store(conics + 3 * i + 1, -b * inverse_determinant, mask=live)
    tl.store(conics + 3 * i + 2, a * inverse_determinant, mask=live)
    tl.store(depths + i, z, mask=live)
    tl.store(extents + i, tl.where(good, extent, 0.0), mask=live)
    wide, high = tl.minimum(half_x, MAX_RADIUS), tl.minimum(half_y, MAX_RADIUS)
    tl.store(radii + 2 * i, tl.where(good, wide, 0.0).to(tl.int32), mask=live)
    tl.store(radii + 2 * i + 1, tl.where(good, high, 0.0).to(tl.int32), mask=live)


@triton.jit(do_not_specialize=["count", "width", "height"])
def project_backward(
    means, quats, scales, covars, view, K, radii, conics, grad_means2d, grad_conics, grad_depths,
    grad_means, grad_quats, grad_scales, grad_covars, grad_camera,
    count, width, height, eps2d, HAS_COVARS: tl.constexpr, WANTS_CAMERA: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of everything; culled Gaussians get zeros. grad_camera is [programs, 16], summed by the caller in order."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < count
    drawn = tl.load(radii + 2 * i, mask=live, other=0) > 0
    w, h = width.to(tl.float32), height.to(tl.float32)
    v00, v01, v02, v03, v10, v11, v12, v13, v20, v21, v22, v23 = _view(view)
    fx, fy, _cx, _cy, left, right, top, bottom = _intrinsics(K, w, h)
    px = tl.load(means + 3 * i, mask=drawn, other=0.0)
    py = tl.load(means + 3 * i + 1, mask=drawn, other=0.0)
    pz = tl.load(means + 3 * i + 2, mask=drawn, other=0.0)
    x = v00 * px + v01 * py + v02 * pz + v03
    y = v10 * px + v11 * py + v12 * pz + v13
    z = tl.where(drawn, v20 * px + v21 * py + v22 * pz + v23, 1.0)
    inverse = 1.0 / z
    ux, uy = x * inverse, y * inverse
    tx, ty = _clamp(ux, left, right), _clamp(uy, top, bottom)
    j00, j02, j11, j12 = fx * inverse, -fx * tx * inverse, fy * inverse, -fy * ty * inverse
    a0, a1, a2 = j00 * v00 + j02 * v20, j00 * v01 + j02 * v21, j00 * v02 + j02 * v22
    b0, b1, b2 = j11 * v10 + j12 * v20, j11 * v11 + j12 * v21, j11 * v12 + j12 * v22
    ga = tl.load(grad_conics + 3 * i, mask=drawn, other=0.0)
    gb = 0.5 * tl.load(grad_conics + 3 * i + 1, mask=drawn, other=0.0)
    gc = tl.load(grad_conics + 3 * i + 2, mask=drawn, other=0.0)
    ca = tl.load(conics + 3 * i, mask=drawn, other=1.0)
    cb = tl.load(conics + 3 * i + 1, mask=drawn, other=0.0)
    cc = tl.load(conics + 3 * i + 2, mask=drawn, other=1.0)
    if HAS_COVARS:
        da0, da1, da2, db0, db1, db2 = _store_covariance_gradient(
            covars, i, live, drawn, a0, a1, a2, b0, b1, b2, ca, cb, cc, ga, gb, gc, grad_covars
        )
    else:
        da0, da1, da2, db0, db1, db2 = _rotation_and_scales_gradient(
            quats, scales, i, live, drawn, a0, a1, a2, b0, b1, b2, eps2d, ca, cb, cc, ga, gb, gc, grad_quats, grad_scales
        )
    # T = J V
    dj00, dj02 = da0 * v00 + da1 * v01 + da2 * v02, da0 * v20 + da1 * v21 + da2 * v22
    dj11, dj12 = db0 * v10 + db1 * v11 + db2 * v12, db0 * v20 + db1 * v21 + db2 * v22
    gu = tl.load(grad_means2d + 2 * i, mask=drawn, other=0.0)
    gv = tl.load(grad_means2d + 2 * i + 1, mask=drawn, other=0.0)
    gz = tl.load(grad_depths + i, mask=drawn, other=0.0)
    dtx, dty = -dj02 * fx * inverse, -dj12 * fy * inverse
    free_x, free_y = tx == ux, ty == uy
    dux = gu * fx + tl.where(free_x, dtx, 0.0)
    duy = gv * fy + tl.where(free_y, dty, 0.0)
    dinverse = dj00 * fx - dj02 * fx * tx + dj11 * fy - dj12 * fy * ty + dux * x + duy * y
    dx, dy, dz = dux * inverse, duy * inverse, -dinverse * inverse * inverse + gz
    tl.store(grad_means + 3 * i, tl.where(drawn, v00 * dx + v10 * dy + v20 * dz, 0.0), mask=live)
    tl.store(grad_means + 3 * i + 1, tl.where(drawn, v01 * dx + v11 * dy + v21 * dz, 0.0), mask=live)
    tl.store(grad_means + 3 * i + 2, tl.where(drawn, v02 * dx + v12 * dy + v22 * dz, 0.0), mask=live)
    if WANTS_CAMERA:
        o = grad_camera + tl.program_id(0) * 16
        held_x, held_y = tl.where(free_x, 0.0, dtx), tl.where(free_y, 0.0, dty)
        _store_sum(o, dx * px + j00 * da0, drawn)
        _store_sum(o + 1, dx * py + j00 * da1, drawn)
        _store_sum(o + 2, dx * pz + j00 * da2, drawn)
        _store_sum(o + 3, dx, drawn)
        _store_sum(o + 4, dy * px + j11 * db0, drawn)
        _store_sum(o + 5, dy * py + j11 * db1, drawn)
        _store_sum(o + 6, dy * pz + j11 * db2, drawn)
        _store_sum(o + 7, dy, drawn)
        _store_sum(o + 8, dz * px + j02 * da0 + j12 * db0, drawn)
        _store_sum(o + 9, dz * py + j02 * da1 + j12 * db1, drawn)
        _store_sum(o + 10, dz * pz + j02 * da2 + j12 * db2, drawn)
        _store_sum(o + 11, dz, drawn)
        _store_sum(o + 12, gu * ux + dj00 * inverse - dj02 * tx * inverse - held_x * tx / fx, drawn)
        _store_sum(o + 13, gv * uy + dj11 * inverse - dj12 * ty * inverse - held_y * ty / fy, drawn)
        _store_sum(o + 14, gu - held_x / fx, drawn)
        _store_sum(o + 15, gv - held_y / fy, drawn)


@triton.jit
def _store_sum(target, values, drawn):
    tl.store(target, tl.sum(tl.where(drawn, values, 0.0), axis=0))


@triton.jit
def _store_covariance_gradient(covars, i, live, drawn, a0, a1, a2, b0, b1, b2, ca, cb, cc, ga, gb, gc, grad_covars):
    """Gradient of the rows a and b of T; fills that of the covariance. ga, gb, gc: of the conic, off-diagonal halved."""
    xx, xy, xz, yy, yz, zz = _load_covariance(covars, i, drawn)
    # conic = inverse of the 2D covariance: dCov = -conic dConic conic
    m00, m01, m10, m11 = ga * ca + gb * cb, ga * cb + gb * cc, gb * ca + gc * cb, gb * cb + gc * cc
    g00, g01, g11 = -(ca * m00 + cb * m10), -(ca * m01 + cb * m11), -(cb * m01 + cc * m11)
    ta0, ta1, ta2 = g00 * a0 + g01 * b0, g00 * a1 + g01 * b1, g00 * a2 + g01 * b2
    tb0, tb1, tb2 = g01 * a0 + g11 * b0, g01 * a1 + g11 * b1, g01 * a2 + g11 * b2
    o = grad_covars + 9 * i
    xy_gradient = tl.where(drawn, a0 * ta1 + b0 * tb1, 0.0)
    xz_gradient = tl.where(drawn, a0 * ta2 + b0 * tb2, 0.0)
    yz_gradient = tl.where(drawn, a1 * ta2 + b1 * tb2, 0.0)
    tl.store(o, tl.where(drawn, a0 * ta0 + b0 * tb0, 0.0), mask=live)
    tl.store(o + 4, tl.where(drawn, a1 * ta1 + b1 * tb1, 0.0), mask=live)
    tl.store(o + 8, tl.where(drawn, a2 * ta2 + b2 * tb2, 0.0), mask=live)
    tl.store(o + 1, xy_gradient, mask=live)
    tl.store(o + 3, xy_gradient, mask=live)
    tl.store(o + 2, xz_gradient, mask=live)
    tl.store(o + 6, xz_gradient, mask=live)
    tl.store(o + 5, yz_gradient, mask=live)
    tl.store(o + 7, yz_gradient, mask=live)
    return (
        2 * (xx * ta0 + xy * ta1 + xz * ta2), 2 * (xy * ta0 + yy * ta1 + yz * ta2), 2 * (xz * ta0 + yz * ta1 + zz * ta2),
        2 * (xx * tb0 + xy * tb1 + xz * tb2), 2 * (xy * tb0 + yy * tb1 + yz * tb2), 2 * (xz * tb0 + yz * tb1 + zz * tb2),
    )  # fmt: skip


@triton.jit
def _arrow_gradient(ux, uy, s, crosses_x, crosses_y, eps2d, inverse_determinant, ca, cb, cc, ga, gb, gc):
    """Of one arrow m = s u: the gradient of m, and of s.

    conic u = (eps u + sum over the arrows k of (m_k x u) turned(m_k)) / determinant; crosses_x and crosses_y are that sum.
    """
    vx, vy = (eps2d * ux + crosses_x) * inverse_determinant, (eps2d * uy + crosses_y) * inverse_determinant
    wx, wy = ga * vx + gb * vy, gb * vx + gc * vy
    return -2 * s * (ca * wx + cb * wy), -2 * s * (cb * wx + cc * wy), -2 * s * (vx * wx + vy * wy)


@triton.jit
def _rotation_and_scales_gradient(
    quats, scales, i, live, drawn, a0, a1, a2, b0, b1, b2, eps2d, ca, cb, cc, ga, gb, gc, grad_quats, grad_scales
):
    """Gradient of the rows a and b of T; fills those of quats and scales. ga, gb, gc: of the conic, off-diagonal halved."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, w, x, y, z, inverse = rotation(quats, i, drawn)
    s0 = tl.load(scales + 3 * i, mask=drawn, other=1.0)
    s1 = tl.load(scales + 3 * i + 1, mask=drawn, other=1.0)
    s2 = tl.load(scales + 3 * i + 2, mask=drawn, other=1.0)
    ux0, uy0 = a0 * r00 + a1 * r10 + a2 * r20, b0 * r00 + b1 * r10 + b2 * r20
    ux1, uy1 = a0 * r01 + a1 * r11 + a2 * r21, b0 * r01 + b1 * r11 + b2 * r21
    ux2, uy2 = a0 * r02 + a1 * r12 + a2 * r22, b0 * r02 + b1 * r12 + b2 * r22
    x0, y0, x1, y1, x2, y2 = ux0 * s0, uy0 * s0, ux1 * s1, uy1 * s1, ux2 * s2, uy2 * s2
    n01, n02, n12 = _cross(x0, y0, x1, y1), _cross(x0, y0, x2, y2), _cross(x1, y1, x2, y2)
    trace = x0 * x0 + x1 * x1 + x2 * x2 + y0 * y0 + y1 * y1 + y2 * y2
    determinant = n01 * n01 + n02 * n02 + n12 * n12 + eps2d * (trace + eps2d)
    inverse_determinant = 1.0 / tl.where(drawn, determinant, 1.0)
    p10, p20 = _cross(x1, y1, ux0, uy0), _cross(x2, y2, ux0, uy0)
    p01, p21 = _cross(x0, y0, ux1, uy1), _cross(x2, y2, ux1, uy1)
    p02, p12 = _cross(x0, y0, ux2, uy2), _cross(x1, y1, ux2, uy2)
    dx0, dy0, ds0 = _arrow_gradient(
        ux0, uy0, s0, -p10 * y1 - p20 * y2, p10 * x1 + p20 * x2, eps2d, inverse_determinant, ca, cb, cc, ga, gb, gc
    )
    dx1, dy1, ds1 = _arrow_gradient(
        ux1, uy1, s1, -p01 * y0 - p21 * y2, p01 * x0 + p21 * x2, eps2d, inverse_determinant, ca, cb, cc, ga, gb, gc
    )
    dx2, dy2, ds2 = _arrow_gradient(
        ux2, uy2, s2, -p02 * y0 - p12 * y1, p02 * x0 + p12 * x1, eps2d, inverse_determinant, ca, cb, cc, ga, gb, gc
    )
    tl.store(grad_scales + 3 * i, tl.where(drawn, ds0, 0.0), mask=live)
    tl.store(grad_scales + 3 * i + 1, tl.where(drawn, ds1, 0.0), mask=live)
    tl.store(grad_scales + 3 * i + 2, tl.where(drawn, ds2, 0.0), mask=live)
    dx0, dy0, dx1, dy1, dx2, dy2 = dx0 * s0, dy0 * s0, dx1 * s1, dy1 * s1, dx2 * s2, dy2 * s2
    gw, gx, gy, gz = rotation_gradient(
        a0 * dx0 + b0 * dy0, a0 * dx1 + b0 * dy1, a0 * dx2 + b0 * dy2,
        a1 * dx0 + b1 * dy0, a1 * dx1 + b1 * dy1, a1 * dx2 + b1 * dy2,
        a2 * dx0 + b2 * dy0, a2 * dx1 + b2 * dy1, a2 * dx2 + b2 * dy2, w, x, y, z, inverse,
    )  # fmt: skip
    tl.store(grad_quats + 4 * i, tl.where(drawn, gw, 0.0), mask=live)
    tl.store(grad_quats + 4 * i + 1, tl.where(drawn, gx, 0.0), mask=live)
    tl.store(grad_quats + 4 * i + 2, tl.where(drawn, gy, 0.0), mask=live)
    tl.store(grad_quats + 4 * i + 3, tl.where(drawn, gz, 0.0), mask=live)
    return (
        dx0 * r00 + dx1 * r01 + dx2 * r02, dx0 * r10 + dx1 * r11 + dx2 * r12, dx0 * r20 + dx1 * r21 + dx2 * r22,
        dy0 * r00 + dy1 * r01 + dy2 * r02, dy0 * r10 + dy1 * r11 + dy2 * r12, dy0 * r20 + dy1 * r21 + dy2 * r22,
    )  # fmt: skip


@triton.jit
def rotation_gradient(d00, d01, d02, d10, d11, d12, d20, d21, d22, w, x, y, z, inverse):
    """Gradient of a quaternion from that of the entries of its rotation; the other arguments are what ``rotation`` gives."""
    gw = 2 * (-z * d01 + y * d02 + z * d10 - x * d12 - y * d20 + x * d21)
    gx = 2 * (y * d01 + z * d02 + y * d10 - 2 * x * d11 - w * d12 + z * d20 + w * d21 - 2 * x * d22)
    gy = 2 * (-2 * y * d00 + x * d01 + w * d02 + x * d10 + z * d12 - w * d20 + z * d21 - 2 * y * d22)
    gz = 2 * (-2 * z * d00 - w * d01 + x * d02 + w * d10 - 2 * z * d11 + y * d12 + x * d20 + y * d21)
    along = gw * w + gx * x + gy * y + gz * z
    return (gw - along * w) * inverse, (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse
