"""Axes, Adam and the step in one sweep over the rows. Oracle: ``reference``."""

from __future__ import annotations

import math

import numpy as np
from numba import float32
from torch import Tensor

from flowsplat.common.kernels import inline, kernel
from flowsplat.common.threads import parallel_for
from flowsplat.training.adam.cpu import B1, B2, EPS, ONE
from flowsplat.training.adam.reference import correction_table
from flowsplat.training.ray_preconditioning import reference
from flowsplat.training.ray_preconditioning.reference import PathSpread

TWO, ZERO = np.float32(2), np.float32(0)


@inline
def _across(x, y, z):
    """A unit vector across the unit vector (x, y, z): its product with the world's axis that is least along it."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax <= ay and ax <= az:
        a, b, c = ZERO, z, -y
    elif ay <= az:
        a, b, c = -z, ZERO, x
    else:
        a, b, c = y, -x, ZERO
    inverse = ONE / max(math.sqrt(a * a + b * b + c * c), float32(1e-9))
    return a * inverse, b * inverse, c * inverse


@inline
def _step_adam(mean, square, i, d, g, rate, correct_m, correct_v):
    """Adam's step of one number, whose moments are changed."""
    m = B1 * mean[i, d] + (ONE - B1) * g
    v = B2 * square[i, d] + (ONE - B2) * g * g
    mean[i, d] = m
    square[i, d] = v
    return -rate * (m * correct_m) / (np.sqrt(v) * correct_v + EPS)


@kernel
def _step(
    begin, end, value, mean, square, counts, rows, stepped, gradient, rates, corrections, middle, spread, focal, most, fewest
):
    last = len(corrections) - 1
    trace = spread[0, 0] + spread[1, 1] + spread[2, 2]
    for a in range(begin, end):
        if stepped[a]:
            i = rows[a]
            x, y, z = value[i, 0] - middle[0], value[i, 1] - middle[1], value[i, 2] - middle[2]
            distance = max(math.sqrt(x * x + y * y + z * z), float32(1e-9))
            inverse = ONE / distance
            x *= inverse
            y *= inverse
            z *= inverse
            along = x * (spread[0, 0] * x + spread[0, 1] * y + spread[0, 2] * z)
            along += y * (spread[1, 0] * x + spread[1, 1] * y + spread[1, 2] * z)
            along += z * (spread[2, 0] * x + spread[2, 1] * y + spread[2, 2] * z)
            travel = math.sqrt(max(trace - along, ZERO))
            pixels = focal * travel * inverse
            seen = pixels * pixels
            factor = min(max(distance / max(TWO * travel, float32(1e-9)), ONE), most)
            factor = ONE + (factor - ONE) * (seen / (seen + fewest * fewest))
            ax, ay, az = _across(x, y, z)
            bx, by, bz = y * az - z * ay, z * ax - x * az, x * ay - y * ax
            step = min(counts[i], last)
            correct_m, correct_v = corrections[step, 0], corrections[step, 1]
            gx, gy, gz = gradient[a, 0], gradient[a, 1], gradient[a, 2]
            sa = _step_adam(mean, square, i, 0, ax * gx + ay * gy + az * gz, rates[0], correct_m, correct_v)
            sb = _step_adam(mean, square, i, 1, bx * gx + by * gy + bz * gz, rates[1], correct_m, correct_v)
            sc = factor * _step_adam(mean, square, i, 2, x * gx + y * gy + z * gz, rates[2], correct_m, correct_v)
            value[i, 0] += sa * ax + sb * bx + sc * x
            value[i, 1] += sa * ay + sb * by + sc * y
            value[i, 2] += sa * az + sb * bz + sc * z


def step_rows(
    value: Tensor, mean: Tensor, square: Tensor, counts: Tensor, rows: Tensor, stepped: Tensor, gradient: Tensor, rates: Tensor,
    path: PathSpread, focal: float, most: float,
) -> None:  # fmt: skip
    """``adam.cpu.step_rows`` in the axes of the rays; the rest as in ``api.step_along_rays``."""
    arrays = (t.numpy() for t in (value, mean, square, counts, rows, stepped, gradient.contiguous(), rates))
    parallel_for(
        _step, len(rows), *arrays, correction_table(),
        path.middle.numpy(), path.covariance.numpy(), np.float32(focal), np.float32(most),
        np.float32(reference.FEWEST_PIXELS),
    )  # fmt: skip
