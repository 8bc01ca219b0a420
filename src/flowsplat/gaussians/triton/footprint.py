"""The footprint of a Gaussian in the image, L = J R S, in Triton: for kernels of what varies inside a Gaussian."""

from __future__ import annotations

import triton
import triton.language as tl

from flowsplat.gaussians.camera_buffer import CX, CY, FX, FY, to_camera, view_row
from flowsplat.gaussians.triton.vectors import load_vector
from flowsplat.splatting.rules import FOOTPRINT_NEAR_PLANE
from flowsplat.splatting.triton.projection import CLAMP_MARGIN, rotation

NEAR_CLIP = tl.constexpr(FOOTPRINT_NEAR_PLANE)


@triton.jit
def tangents(camera, x, y, z, width, height):
    """1 / z and the tangents, held as the rasterizer holds them."""
    fx, fy, cx, cy = tl.load(camera + FX), tl.load(camera + FY), tl.load(camera + CX), tl.load(camera + CY)
    inverse = 1.0 / tl.where(z > NEAR_CLIP, z, NEAR_CLIP)
    tx = tl.minimum(tl.maximum(x * inverse, (cx + width * CLAMP_MARGIN) / -fx), (cx - (width + width * CLAMP_MARGIN)) / -fx)
    ty = tl.minimum(tl.maximum(y * inverse, (cy + height * CLAMP_MARGIN) / -fy), (cy - (height + height * CLAMP_MARGIN)) / -fy)
    return inverse, tx, ty


@triton.jit
def jacobian_row(camera, row: tl.constexpr, tangent, inverse):
    """Row 0 or 1 of the derivative of the pixel with respect to the point in the world."""
    scale = (tl.load(camera + FX) if row == 0 else tl.load(camera + FY)) * inverse
    x, y, z = view_row(camera, row)
    depth_x, depth_y, depth_z = view_row(camera, 2)
    return scale * (x - tangent * depth_x), scale * (y - tangent * depth_y), scale * (z - tangent * depth_z)


@triton.jit
def _row_times(a, b, c, r00, r01, r02, r10, r11, r12, r20, r21, r22, s0, s1, s2):
    """One row of J R S from that of J."""
    return (
        (a * r00 + b * r10 + c * r20) * s0, (a * r01 + b * r11 + c * r21) * s1, (a * r02 + b * r12 + c * r22) * s2
    )  # fmt: skip


@triton.jit
def footprint(means, quats, s0, s1, s2, camera, i, mask, width, height):
    """The rows of L = J R S, and the point in camera axes."""
    px, py, pz = load_vector(means, i, mask)
    x, y, z = to_camera(camera, px, py, pz)
    inverse, tx, ty = tangents(camera, x, y, z, width, height)
    r00, r01, r02, r10, r11, r12, r20, r21, r22, _, _, _, _, _ = rotation(quats, i, mask)
    a, b, c = jacobian_row(camera, 0, tx, inverse)
    p0, p1, p2 = _row_times(a, b, c, r00, r01, r02, r10, r11, r12, r20, r21, r22, s0, s1, s2)
    a, b, c = jacobian_row(camera, 1, ty, inverse)
    q0, q1, q2 = _row_times(a, b, c, r00, r01, r02, r10, r11, r12, r20, r21, r22, s0, s1, s2)
    return p0, p1, p2, q0, q1, q2, x, y, z
