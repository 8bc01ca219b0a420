"""Colors from spherical harmonics and their gradient, one Gaussian at a time. Oracle: ``harmonics.colors_in_torch``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from flowsplat.common.kernels import helper, inline, kernel
from flowsplat.common.threads import parallel_for
from flowsplat.splatting.cpu.projection import HALF, ONE, TWO, ZERO
from flowsplat.splatting.rules import C0, C1, C2, C3, C4

CHUNKS = 64
"""Ranges into which Gaussians are cut, whatever the number of threads."""
S0, S1 = np.float32(C0), np.float32(C1)
S2, S3, S4 = np.array(C2, np.float32), np.array(C3, np.float32), np.array(C4, np.float32)
THREE, FOUR, SIX, EIGHT = np.float32(3), np.float32(4), np.float32(6), np.float32(8)
SEVEN, FOURTEEN, FIFTEEN = np.float32(7), np.float32(14), np.float32(15)
TWENTY_ONE, THIRTY, THIRTY_FIVE = np.float32(21), np.float32(30), np.float32(35)
BASES = 25
"""Of degree 4. Slicing, which has no more than degree 3, calls ``basis_of`` with 16."""


@helper
def basis_of(x, y, z, count, basis):
    """The first ``count`` (1, 4, 9 or 16) basis functions of a direction of any length."""
    length = math.sqrt(x * x + y * y + z * z)
    inverse = ONE / max(length, float32(1e-12))
    x *= inverse
    y *= inverse
    z *= inverse
    basis[0] = S0
    if count > 1:
        basis[1], basis[2], basis[3] = -S1 * y, S1 * z, -S1 * x
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        basis[4], basis[5], basis[6] = S2[0] * x * y, S2[1] * y * z, S2[2] * (TWO * zz - xx - yy)
        basis[7], basis[8] = S2[3] * x * z, S2[4] * (xx - yy)
        if count > 9:
            basis[9], basis[10] = S3[0] * y * (THREE * xx - yy), S3[1] * x * y * z
            basis[11] = S3[2] * y * (FOUR * zz - xx - yy)
            basis[12] = S3[3] * z * (TWO * zz - THREE * xx - THREE * yy)
            basis[13] = S3[4] * x * (FOUR * zz - xx - yy)
            basis[14], basis[15] = S3[5] * z * (xx - yy), S3[6] * x * (xx - THREE * yy)


@helper
def _add_degree_4(x, y, z, basis):
    """Basis functions 16 to 24 of a direction of any length, by themselves: training, which has none of them, does not look."""
    inverse = ONE / max(math.sqrt(x * x + y * y + z * z), float32(1e-12))
    x *= inverse
    y *= inverse
    z *= inverse
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    basis[16], basis[17] = S4[0] * xy * (xx - yy), S4[1] * yz * (THREE * xx - yy)
    basis[18], basis[19] = S4[2] * xy * (SEVEN * zz - ONE), S4[3] * yz * (SEVEN * zz - THREE)
    basis[20], basis[21] = S4[4] * (zz * (THIRTY_FIVE * zz - THIRTY) + THREE), S4[5] * xz * (SEVEN * zz - THREE)
    basis[22], basis[23] = S4[6] * (xx - yy) * (SEVEN * zz - ONE), S4[7] * xz * (xx - THREE * yy)
    basis[24] = S4[8] * (xx * (xx - THREE * yy) - yy * (THREE * xx - yy))


@helper
def _degree_4_gradient(x, y, z, d):
    """As ``_basis_gradient``, of basis functions 16 to 24 of d [25] alone."""
    inverse = ONE / max(math.sqrt(x * x + y * y + z * z), float32(1e-12))
    x *= inverse
    y *= inverse
    z *= inverse
    xx, yy, zz, xy = x * x, y * y, z * z, x * y
    d16, d17, d18, d19, d20 = S4[0] * d[16], S4[1] * d[17], S4[2] * d[18], S4[3] * d[19], S4[4] * d[20]
    d21, d22, d23, d24 = S4[5] * d[21], S4[6] * d[22], S4[7] * d[23], FOUR * S4[8] * d[24]
    one, three, slope = SEVEN * zz - ONE, SEVEN * zz - THREE, TWENTY_ONE * zz - THREE
    gx = d16 * y * (THREE * xx - yy) + SIX * d17 * xy * z + d18 * y * one + d21 * z * three
    gx += TWO * d22 * x * one + THREE * d23 * z * (xx - yy) + d24 * x * (xx - THREE * yy)
    gy = d16 * x * (xx - THREE * yy) + THREE * d17 * z * (xx - yy) + d18 * x * one + d19 * z * three
    gy += -TWO * d22 * y * one - SIX * d23 * xy * z + d24 * y * (yy - THREE * xx)
    gz = d17 * y * (THREE * xx - yy) + FOURTEEN * z * (d18 * xy + d22 * (xx - yy))
    gz += (d19 * y + d21 * x) * slope + FOUR * d20 * z * (THIRTY_FIVE * zz - FIFTEEN) + d23 * x * (xx - THREE * yy)
    along = gx * x + gy * y + gz * z
    return (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse


@inline
def color_of(basis, sh, i, count):
    """Red, green and blue of Gaussian i in the direction of the basis, before negative ones become 0."""
    red, green, blue = HALF, HALF, HALF
    for k in range(count):
        red += basis[k] * sh[i, k, 0]
        green += basis[k] * sh[i, k, 1]
        blue += basis[k] * sh[i, k, 2]
    return red, green, blue


@inline
def _basis_gradient(x, y, z, count, d):
    """Gradient of the direction, of any length, from that of the basis d [16]."""
    inverse = ONE / max(math.sqrt(x * x + y * y + z * z), float32(1e-12))
    x *= inverse
    y *= inverse
    z *= inverse
    gx, gy, gz = -S1 * d[3], -S1 * d[1], S1 * d[2]
    if count > 4:
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        d4, d5, d6, d7, d8 = S2[0] * d[4], S2[1] * d[5], S2[2] * d[6], S2[3] * d[7], S2[4] * d[8]
        gx += d4 * y - TWO * d6 * x + d7 * z + TWO * d8 * x
        gy += d4 * x + d5 * z - TWO * d6 * y - TWO * d8 * y
        gz += d5 * y + FOUR * d6 * z + d7 * x
        if count > 9:
            d9, d10, d11, d12 = S3[0] * d[9], S3[1] * d[10], S3[2] * d[11], S3[3] * d[12]
            d13, d14, d15 = S3[4] * d[13], S3[5] * d[14], S3[6] * d[15]
            gx += SIX * (d9 * xy - d12 * xz) + d10 * yz - TWO * d11 * xy + d13 * (FOUR * zz - THREE * xx - yy)
            gx += TWO * d14 * xz + THREE * d15 * (xx - yy)
            gy += THREE * d9 * (xx - yy) + d10 * xz + d11 * (FOUR * zz - xx - THREE * yy) - SIX * d12 * yz
            gy += -TWO * (d13 * xy + d14 * yz) - SIX * d15 * xy
            gz += d10 * xy + EIGHT * (d11 * yz + d13 * xz) + THREE * d12 * (TWO * zz - xx - yy) + d14 * (xx - yy)
    along = gx * x + gy * y + gz * z
    return (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse


@kernel
def _forward(begin, end, sh, directions, count, colors):
    number = len(sh)
    for chunk in range(begin, end):
        basis = np.empty(BASES, np.float32)
        for i in range(number * chunk // CHUNKS, number * (chunk + 1) // CHUNKS):
            basis_of(directions[i, 0], directions[i, 1], directions[i, 2], count, basis)
            if count > 16:
                _add_degree_4(directions[i, 0], directions[i, 1], directions[i, 2], basis)
            red, green, blue = color_of(basis, sh, i, count)
            colors[i, 0], colors[i, 1], colors[i, 2] = max(red, ZERO), max(green, ZERO), max(blue, ZERO)


@kernel
def _backward(begin, end, sh, directions, count, colors, gradient, wants_directions, d_sh, d_directions):
    number = len(sh)
    for chunk in range(begin, end):
        basis, d_basis = np.empty(BASES, np.float32), np.empty(BASES, np.float32)
        for i in range(number * chunk // CHUNKS, number * (chunk + 1) // CHUNKS):
            x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
            basis_of(x, y, z, count, basis)
            if count > 16:
                _add_degree_4(x, y, z, basis)
            red = gradient[i, 0] if colors[i, 0] > ZERO else ZERO
            green = gradient[i, 1] if colors[i, 1] > ZERO else ZERO
            blue = gradient[i, 2] if colors[i, 2] > ZERO else ZERO
            for k in range(count):
                d_sh[i, k, 0], d_sh[i, k, 1], d_sh[i, k, 2] = basis[k] * red, basis[k] * green, basis[k] * blue
                d_basis[k] = red * sh[i, k, 0] + green * sh[i, k, 1] + blue * sh[i, k, 2]
            for k in range(count, sh.shape[1]):
                d_sh[i, k, 0], d_sh[i, k, 1], d_sh[i, k, 2] = ZERO, ZERO, ZERO
            if wants_directions:
                dx, dy, dz = _basis_gradient(x, y, z, count, d_basis)
                if count > 16:
                    more_x, more_y, more_z = _degree_4_gradient(x, y, z, d_basis)
                    dx, dy, dz = dx + more_x, dy + more_y, dz + more_z
                d_directions[i, 0], d_directions[i, 1], d_directions[i, 2] = dx, dy, dz


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor, directions: Tensor, count: int) -> Tensor:
        colors = torch.empty(len(sh), 3)
        parallel_for(_forward, CHUNKS, _array(sh), _array(directions), count, colors.numpy())
        ctx.save_for_backward(sh, directions, colors)
        ctx.count = count
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        sh, directions, colors = ctx.saved_tensors
        wants_directions = ctx.needs_input_grad[1]
        d_sh = torch.empty(sh.shape)
        d_directions = torch.empty(len(d_sh) if wants_directions else 0, 3)
        parallel_for(
            _backward,
            CHUNKS,
            _array(sh),
            _array(directions),
            ctx.count,
            _array(colors),
            _array(gradient),
            wants_directions,
            d_sh.numpy(),
            d_directions.numpy(),
        )
        return d_sh, d_directions if wants_directions else None, None


def colors(sh: Tensor, directions: Tensor, degree: int) -> Tensor:
    """See ``harmonics.colors_from_harmonics``; float32, degree 1 to 4."""
    result: Tensor = _Colors.apply(sh, directions, (degree + 1) ** 2)
    return result
