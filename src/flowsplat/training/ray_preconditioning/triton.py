"""Axes, Adam and the step as one Triton kernel, a lane a row. Oracle: ``reference``; what is computed is what ``cpu`` computes."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from flowsplat.common.triton import device_of, rows_per_program
from flowsplat.training.adam.triton import B1, B2, C1, C2, EPS, corrections_on
from flowsplat.training.ray_preconditioning import reference
from flowsplat.training.ray_preconditioning.reference import PathSpread

TINY = tl.constexpr(1e-9)


@triton.jit
def _step_adam(mean, square, at, g, rate, correct_m, correct_v, mask):
    """Adam's step of one number, whose moments are changed."""
    m = tl.load(mean + at, mask=mask, other=0.0) * B1 + g * C1
    v = tl.load(square + at, mask=mask, other=0.0) * B2 + g * g * C2
    tl.store(mean + at, m, mask=mask)
    tl.store(square + at, v, mask=mask)
    return -rate * (m * correct_m) / (tl.sqrt(v) * correct_v + EPS)


@triton.jit(do_not_specialize=["count", "last"], do_not_specialize_on_alignment=["rows", "stepped", "gradient", "rates"])
def _step(
    value, mean, square, counts, rows, stepped, gradient, rates, corrections, path, focal, most, fewest, count, last,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """path: ``PathSpread.numbers``."""
    a = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = a < count
    inside &= tl.load(stepped + a, mask=inside, other=0) != 0
    at = 3 * tl.load(rows + a, mask=inside, other=0)
    px = tl.load(value + at, mask=inside, other=0.0)
    py = tl.load(value + at + 1, mask=inside, other=0.0)
    pz = tl.load(value + at + 2, mask=inside, other=0.0)
    x, y, z = px - tl.load(path), py - tl.load(path + 1), pz - tl.load(path + 2)
    distance = tl.maximum(tl.sqrt(x * x + y * y + z * z), TINY)
    inverse = 1.0 / distance
    x, y, z = x * inverse, y * inverse, z * inverse
    along = x * (tl.load(path + 3) * x + tl.load(path + 4) * y + tl.load(path + 5) * z)
    along += y * (tl.load(path + 6) * x + tl.load(path + 7) * y + tl.load(path + 8) * z)
    along += z * (tl.load(path + 9) * x + tl.load(path + 10) * y + tl.load(path + 11) * z)
    trace = tl.load(path + 3) + tl.load(path + 7) + tl.load(path + 11)
    travel = tl.sqrt(tl.maximum(trace - along, 0.0))
    pixels = focal * travel * inverse
    seen = pixels * pixels
    factor = tl.minimum(tl.maximum(distance / tl.maximum(travel * 2.0, TINY), 1.0), most)
    factor = (factor - 1.0) * (seen / (seen + fewest * fewest)) + 1.0
    # A unit vector across the ray: the product with the world's axis that is least along it.
    ax, ay, az = tl.abs(x), tl.abs(y), tl.abs(z)
    by_x = (ax <= ay) & (ax <= az)
    by_y = (ay <= az) & (by_x == 0)
    ux = tl.where(by_x, 0.0, tl.where(by_y, -z, y))
    uy = tl.where(by_x, z, tl.where(by_y, 0.0, -x))
    uz = tl.where(by_x, -y, tl.where(by_y, x, 0.0))
    length = 1.0 / tl.maximum(tl.sqrt(ux * ux + uy * uy + uz * uz), TINY)
    ux, uy, uz = ux * length, uy * length, uz * length
    vx, vy, vz = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
    taken = tl.minimum(tl.load(counts + at // 3, mask=inside, other=0), last)
    correct_m = tl.load(corrections + taken * 2, mask=inside, other=0.0)
    correct_v = tl.load(corrections + taken * 2 + 1, mask=inside, other=0.0)
    gx = tl.load(gradient + 3 * a, mask=inside, other=0.0)
    gy = tl.load(gradient + 3 * a + 1, mask=inside, other=0.0)
    gz = tl.load(gradient + 3 * a + 2, mask=inside, other=0.0)
    su = _step_adam(mean, square, at, ux * gx + uy * gy + uz * gz, tl.load(rates), correct_m, correct_v, inside)
    sv = _step_adam(mean, square, at + 1, vx * gx + vy * gy + vz * gz, tl.load(rates + 1), correct_m, correct_v, inside)
    sw = factor * _step_adam(mean, square, at + 2, x * gx + y * gy + z * gz, tl.load(rates + 2), correct_m, correct_v, inside)
    tl.store(value + at, px + su * ux + sv * vx + sw * x, mask=inside)
    tl.store(value + at + 1, py + su * uy + sv * vy + sw * y, mask=inside)
    tl.store(value + at + 2, pz + su * uz + sv * vz + sw * z, mask=inside)


def step_rows(
    value: Tensor, mean: Tensor, square: Tensor, counts: Tensor, rows: Tensor, stepped: Tensor, gradient: Tensor, rates: Tensor,
    path: PathSpread, focal: float, most: float,
) -> None:  # fmt: skip
    """As ``cpu.step_rows``."""
    table = corrections_on(value.device)
    block = rows_per_program(len(rows))
    with device_of(value):
        _step[(triton.cdiv(len(rows), block),)](
            value, mean, square, counts, rows, stepped.view(torch.uint8), gradient.contiguous(), rates, table, path.numbers,
            float(focal), float(most), float(reference.FEWEST_PIXELS), len(rows), len(table) - 1, BLOCK=block,
        )  # fmt: skip
