"""The features of color, depth and affine flow, and their gradient, in one Triton kernel each. Oracle: ``reference``.

The formulas are those of ``cpu.affine``: with L = J R S of a Gaussian now and L' at the other time, the matrix of affine flow is
B = (L' - L) L^T (L L^T + eps)^-1. As in ``displacement`` there is always a last channel.
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
from flowsplat.gaussians.camera_buffer import CAMERA, CX, CY, FX, FY, camera_numbers, to_camera, to_world, view_row
from flowsplat.gaussians.slicing import Slice
from flowsplat.gaussians.triton.footprint import NEAR_CLIP, footprint, jacobian_row, tangents
from flowsplat.gaussians.triton.vectors import load_vector, store_vector
from flowsplat.geometry import Camera
from flowsplat.splatting import Projected
from flowsplat.splatting.rules import EPS2D
from flowsplat.splatting.triton.projection import rotation, rotation_gradient

CHANNELS = 11
"""Color 3, depth, flow at the center of the image 2, B by rows 4, unseen."""
BLUR_VARIANCE = tl.constexpr(EPS2D)


@triton.jit
def _products(p0, p1, p2, q0, q1, q2, n0, n1, n2, m0, m1, m2):
    """B by rows and the inverse of L L^T + eps (xx, xy, yy), from the rows p, q of L and n, m of L'."""
    a, b, c = p0 * p0 + p1 * p1 + p2 * p2, p0 * q0 + p1 * q1 + p2 * q2, q0 * q0 + q1 * q1 + q2 * q2
    z00, z01 = n0 * p0 + n1 * p1 + n2 * p2 - a, n0 * q0 + n1 * q1 + n2 * q2 - b
    z10, z11 = m0 * p0 + m1 * p1 + m2 * p2 - b, m0 * q0 + m1 * q1 + m2 * q2 - c
    a += BLUR_VARIANCE
    c += BLUR_VARIANCE
    inverse = 1.0 / (a * c - b * b)
    xx, xy, yy = c * inverse, -b * inverse, a * inverse
    return z00 * xx + z01 * xy, z00 * xy + z01 * yy, z10 * xx + z11 * xy, z10 * xy + z11 * yy, xx, xy, yy


@triton.jit(do_not_specialize=["count"])
def _forward(
    colors, depths, means2d, means, quats, scales, next_means, next_quats, cameras, features, width, height, count,
    BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    s0, s1, s2 = load_vector(scales, i, inside)
    p0, p1, p2, q0, q1, q2, _, _, _ = footprint(means, quats, s0, s1, s2, cameras, i, inside, width, height)
    later = cameras + CAMERA
    n0, n1, n2, m0, m1, m2, x, y, z = footprint(next_means, next_quats, s0, s1, s2, later, i, inside, width, height)
    front = z > NEAR_CLIP
    b00, b01, b10, b11, _, _, _ = _products(p0, p1, p2, q0, q1, q2, n0, n1, n2, m0, m1, m2)
    inverse = 1.0 / tl.where(front, z, 1.0)
    u, v = tl.load(means2d + i * 2, mask=inside, other=0.0), tl.load(means2d + i * 2 + 1, mask=inside, other=0.0)
    cx, cy = u - 0.5 * width, v - 0.5 * height
    du = tl.load(later + FX) * x * inverse + tl.load(later + CX) - u - (b00 * cx + b01 * cy)
    dv = tl.load(later + FY) * y * inverse + tl.load(later + CY) - v - (b10 * cx + b11 * cy)
    red, green, blue = load_vector(colors, i, inside)
    row = features + i * 11
    tl.store(row, red, mask=inside)
    tl.store(row + 1, green, mask=inside)
    tl.store(row + 2, blue, mask=inside)
    tl.store(row + 3, tl.load(depths + i, mask=inside, other=0.0), mask=inside)
    tl.store(row + 4, tl.where(front, du, 0.0), mask=inside)
    tl.store(row + 5, tl.where(front, dv, 0.0), mask=inside)
    tl.store(row + 6, tl.where(front, b00, 0.0), mask=inside)
    tl.store(row + 7, tl.where(front, b01, 0.0), mask=inside)
    tl.store(row + 8, tl.where(front, b10, 0.0), mask=inside)
    tl.store(row + 9, tl.where(front, b11, 0.0), mask=inside)
    tl.store(row + 10, tl.where(front, 0.0, 1.0), mask=inside)


@triton.jit
def _footprint_gradient(
    means, quats, s0, s1, s2, camera, i, mask, front, width, height, p0, p1, p2, q0, q1, q2, gu, gv, d_means, d_quats
):  # fmt: skip
    """Write the gradients of mean and quaternion and return that of the scales.

    p and q are the gradients of the rows of L, gu and gv that of the pixel; front: where there is any.
    """
    fx, fy = tl.load(camera + FX), tl.load(camera + FY)
    px, py, pz = load_vector(means, i, mask)
    x, y, z = to_camera(camera, px, py, pz)
    inverse, tx, ty = tangents(camera, x, y, z, width, height)
    r00, r01, r02, r10, r11, r12, r20, r21, r22, w, qx, qy, qz, length = rotation(quats, i, mask)
    # Of the rows of J in the world, from R S.
    a0, b0 = r00 * s0 * p0 + r01 * s1 * p1 + r02 * s2 * p2, r00 * s0 * q0 + r01 * s1 * q1 + r02 * s2 * q2
    a1, b1 = r10 * s0 * p0 + r11 * s1 * p1 + r12 * s2 * p2, r10 * s0 * q0 + r11 * s1 * q1 + r12 * s2 * q2
    a2, b2 = r20 * s0 * p0 + r21 * s1 * p1 + r22 * s2 * p2, r20 * s0 * q0 + r21 * s1 * q1 + r22 * s2 * q2
    v00, v01, v02 = view_row(camera, 0)
    v10, v11, v12 = view_row(camera, 1)
    v20, v21, v22 = view_row(camera, 2)
    dj00, dj11 = a0 * v00 + a1 * v01 + a2 * v02, b0 * v10 + b1 * v11 + b2 * v12
    dj02, dj12 = a0 * v20 + a1 * v21 + a2 * v22, b0 * v20 + b1 * v21 + b2 * v22
    dux = gu * fx - tl.where(tx == x * inverse, dj02 * fx * inverse, 0.0)
    duy = gv * fy - tl.where(ty == y * inverse, dj12 * fy * inverse, 0.0)
    d_inverse = fx * (dj00 - dj02 * tx) + fy * (dj11 - dj12 * ty) + dux * x + duy * y
    dz = tl.where(z > NEAR_CLIP, -d_inverse * inverse * inverse, 0.0)
    wx, wy, wz = to_world(camera, dux * inverse, duy * inverse, dz)
    store_vector(d_means, i, tl.where(front, wx, 0.0), tl.where(front, wy, 0.0), tl.where(front, wz, 0.0), mask)
    # The gradient of R S is J^T times that of L.
    ja, jb, jc = jacobian_row(camera, 0, tx, inverse)
    ka, kb, kc = jacobian_row(camera, 1, ty, inverse)
    p0, p1, p2 = tl.where(front, p0, 0.0), tl.where(front, p1, 0.0), tl.where(front, p2, 0.0)
    q0, q1, q2 = tl.where(front, q0, 0.0), tl.where(front, q1, 0.0), tl.where(front, q2, 0.0)
    w00, w01, w02 = ja * p0 + ka * q0, ja * p1 + ka * q1, ja * p2 + ka * q2
    w10, w11, w12 = jb * p0 + kb * q0, jb * p1 + kb * q1, jb * p2 + kb * q2
    w20, w21, w22 = jc * p0 + kc * q0, jc * p1 + kc * q1, jc * p2 + kc * q2
    gw, gx, gy, gz = rotation_gradient(
        w00 * s0, w01 * s1, w02 * s2, w10 * s0, w11 * s1, w12 * s2, w20 * s0, w21 * s1, w22 * s2, w, qx, qy, qz, length
    )
    tl.store(d_quats + i * 4, gw, mask=mask)
    store_vector(d_quats + 1, i, gx, gy, gz, mask, 4)
    return r00 * w00 + r10 * w10 + r20 * w20, r01 * w01 + r11 * w11 + r21 * w21, r02 * w02 + r12 * w12 + r22 * w22


@triton.jit(do_not_specialize=["count"])
def _backward(
    gradient, means2d, means, quats, scales, next_means, next_quats, cameras, d_colors, d_depths, d_means2d, d_means, d_quats,
    d_scales, d_next_means, d_next_quats, width, height, count, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    row = gradient + i * 11
    red, green = tl.load(row, mask=inside, other=0.0), tl.load(row + 1, mask=inside, other=0.0)
    store_vector(d_colors, i, red, green, tl.load(row + 2, mask=inside, other=0.0), inside)
    tl.store(d_depths + i, tl.load(row + 3, mask=inside, other=0.0), mask=inside)
    s0, s1, s2 = load_vector(scales, i, inside)
    later = cameras + CAMERA
    p0, p1, p2, q0, q1, q2, _, _, _ = footprint(means, quats, s0, s1, s2, cameras, i, inside, width, height)
    n0, n1, n2, m0, m1, m2, _, _, z = footprint(next_means, next_quats, s0, s1, s2, later, i, inside, width, height)
    front = inside & (z > NEAR_CLIP)
    b00, b01, b10, b11, xx, xy, yy = _products(p0, p1, p2, q0, q1, q2, n0, n1, n2, m0, m1, m2)
    gu, gv = tl.load(row + 4, mask=front, other=0.0), tl.load(row + 5, mask=front, other=0.0)
    cx = tl.load(means2d + i * 2, mask=inside, other=0.0) - 0.5 * width
    cy = tl.load(means2d + i * 2 + 1, mask=inside, other=0.0) - 0.5 * height
    g00, g01 = tl.load(row + 6, mask=front, other=0.0) - gu * cx, tl.load(row + 7, mask=front, other=0.0) - gu * cy
    g10, g11 = tl.load(row + 8, mask=front, other=0.0) - gv * cx, tl.load(row + 9, mask=front, other=0.0) - gv * cy
    tl.store(d_means2d + i * 2, tl.where(front, -gu - b00 * gu - b10 * gv, 0.0), mask=inside)
    tl.store(d_means2d + i * 2 + 1, tl.where(front, -gv - b01 * gu - b11 * gv, 0.0), mask=inside)
    # B = Z A^-1 with Z = L' L^T - L L^T and A = L L^T + eps: dZ = H = dB A^-1 and dA = -B^T H.
    h00, h01, h10, h11 = g00 * xx + g01 * xy, g00 * xy + g01 * yy, g10 * xx + g11 * xy, g10 * xy + g11 * yy
    y00, y01 = -h00 - b00 * h00 - b10 * h10, -h01 - b00 * h01 - b10 * h11
    y10, y11 = -h10 - b01 * h00 - b11 * h10, -h11 - b01 * h01 - b11 * h11
    cross = y01 + y10
    e0, f0 = h00 * n0 + h10 * m0 + 2.0 * y00 * p0 + cross * q0, h01 * n0 + h11 * m0 + cross * p0 + 2.0 * y11 * q0
    e1, f1 = h00 * n1 + h10 * m1 + 2.0 * y00 * p1 + cross * q1, h01 * n1 + h11 * m1 + cross * p1 + 2.0 * y11 * q1
    e2, f2 = h00 * n2 + h10 * m2 + 2.0 * y00 * p2 + cross * q2, h01 * n2 + h11 * m2 + cross * p2 + 2.0 * y11 * q2
    zero = tl.zeros_like(gu)
    t0, t1, t2 = _footprint_gradient(
        means, quats, s0, s1, s2, cameras, i, inside, front, width, height, e0, e1, e2, f0, f1, f2, zero, zero, d_means, d_quats
    )
    e0, e1, e2 = h00 * p0 + h01 * q0, h00 * p1 + h01 * q1, h00 * p2 + h01 * q2
    f0, f1, f2 = h10 * p0 + h11 * q0, h10 * p1 + h11 * q1, h10 * p2 + h11 * q2
    u0, u1, u2 = _footprint_gradient(
        next_means, next_quats, s0, s1, s2, later, i, inside, front, width, height, e0, e1, e2, f0, f1, f2, gu, gv, d_next_means,
        d_next_quats,
    )  # fmt: skip
    store_vector(d_scales, i, t0 + u0, t1 + u1, t2 + u2, inside)


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, colors: Tensor, depths: Tensor, means2d: Tensor, means: Tensor, quats: Tensor, scales: Tensor,
        next_means: Tensor, next_quats: Tensor, cameras: Tensor, width: int, height: int,
    ) -> Tensor:  # fmt: skip
        given = (colors, depths, means2d, means, quats, scales, next_means, next_quats)
        inputs = [tensor.detach().contiguous() for tensor in given]
        count, size = len(colors), (float(width), float(height))
        features = torch.empty(count, CHANNELS, device=colors.device)
        if count:
            block = rows_per_program(count)
            with device_of(colors):
                _forward[(triton.cdiv(count, block),)](*inputs, cameras, features, *size, count, BLOCK=block)
        ctx.save_for_backward(*given[2:], cameras)
        ctx.size = size
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        count, device = len(gradient), gradient.device
        shapes = ((count, 3), (count,), *((count, size) for size in (2, 3, 4, 3, 3, 4)))
        results = [torch.empty(shape, device=device) for shape in shapes]
        inputs = [tensor.contiguous() for tensor in ctx.saved_tensors]
        if count:
            block = rows_per_program(count)
            with device_of(gradient):
                _backward[(triton.cdiv(count, block),)](gradient.contiguous(), *inputs, *results, *ctx.size, count, BLOCK=block)
        return *results, None, None, None


def blend_affine(sliced: Slice, projected: Projected, camera: Camera, other: Camera) -> Tensor:
    """See ``api.blend_features``; from the Gaussians in ``camera`` to where they are next in the ``other`` one."""
    cameras = upload(camera_numbers(camera, other), sliced.means.device)
    result: Tensor = _Features.apply(
        sliced.colors, projected.depths, projected.means2d, sliced.means, sliced.quats, sliced.scales, sliced.next_means,
        sliced.next_quats, cameras, camera.width, camera.height,
    )  # fmt: skip
    return result
