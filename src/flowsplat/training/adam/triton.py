"""Take one Adam step for some rows of a parameter as a Triton kernel, a lane a number. Oracle: ``reference``."""

from __future__ import annotations

import functools

import torch
import triton
import triton.language as tl
from torch import Tensor

from flowsplat.common.triton import device_of, rows_per_program
from flowsplat.training.adam.reference import BETA1, BETA2, EPSILON, correction_table

B1, B2, EPS = tl.constexpr(BETA1), tl.constexpr(BETA2), tl.constexpr(EPSILON)
C1, C2 = tl.constexpr(1 - BETA1), tl.constexpr(1 - BETA2)


# Parts of tensors begin at any place: compiled for each alignment of each of them, a run would compile for minutes.
@triton.jit(do_not_specialize=["count", "last"], do_not_specialize_on_alignment=["rows", "stepped", "gradient", "rates"])
def _step(
    value, mean, square, counts, rows, stepped, gradient, rates, corrections, count, last, D: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    k = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    a, d = k // D, k % D
    inside = k < count * D
    inside &= tl.load(stepped + a, mask=inside, other=0) != 0
    i = tl.load(rows + a, mask=inside, other=0)
    taken = tl.minimum(tl.load(counts + i, mask=inside, other=0), last)
    correct_m = tl.load(corrections + taken * 2, mask=inside, other=0.0)
    correct_v = tl.load(corrections + taken * 2 + 1, mask=inside, other=0.0)
    at = i * D + d
    g = tl.load(gradient + k, mask=inside, other=0.0)
    m = B1 * tl.load(mean + at, mask=inside, other=0.0) + C1 * g
    v = B2 * tl.load(square + at, mask=inside, other=0.0) + C2 * g * g
    tl.store(mean + at, m, mask=inside)
    tl.store(square + at, v, mask=inside)
    step = tl.load(rates + d, mask=inside, other=0.0) * (m * correct_m) / (tl.sqrt(v) * correct_v + EPS)
    tl.store(value + at, tl.load(value + at, mask=inside, other=0.0) - step, mask=inside)


@functools.cache
def corrections_on(device: torch.device) -> Tensor:
    """``correction_table`` on a device."""
    return torch.from_numpy(correction_table()).to(device)


def step_rows(
    value: Tensor, mean: Tensor, square: Tensor, counts: Tensor, rows: Tensor, stepped: Tensor, gradient: Tensor, rates: Tensor
) -> None:
    """See ``reference.step_rows``."""
    count, size = gradient.shape
    table = corrections_on(value.device)
    block = rows_per_program(count * size)
    with device_of(value):
        _step[(triton.cdiv(count * size, block),)](
            value, mean, square, counts, rows, stepped.view(torch.uint8), gradient.contiguous(), rates, table, count,
            len(table) - 1, D=size, BLOCK=block,
        )  # fmt: skip
