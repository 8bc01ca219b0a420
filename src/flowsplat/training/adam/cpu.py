"""One Adam step for some rows of a parameter. Oracle: ``reference``."""

from __future__ import annotations

import functools

import numpy as np
from numba import prange
from torch import Tensor

from flowsplat.common.kernels import parallel_kernel
from flowsplat.training.adam.reference import BETA1, BETA2, EPSILON

B1, B2, EPS, ONE = np.float32(BETA1), np.float32(BETA2), np.float32(EPSILON), np.float32(1)
LONGEST = 1 << 15
"""Steps after which the bias correction of the second moment is 1 in float32."""


@parallel_kernel
def _step(value, mean, square, counts, rows, stepped, gradient, rates, corrections):
    last = len(corrections) - 1
    for a in prange(len(rows)):
        if stepped[a]:
            i = rows[a]
            step = min(counts[i], last)
            correct_m, correct_v = corrections[step, 0], corrections[step, 1]
            for d in range(gradient.shape[1]):
                g = gradient[a, d]
                m = B1 * mean[i, d] + (ONE - B1) * g
                v = B2 * square[i, d] + (ONE - B2) * g * g
                mean[i, d] = m
                square[i, d] = v
                value[i, d] -= rates[d] * (m * correct_m) / (np.sqrt(v) * correct_v + EPS)


@functools.cache
def _corrections() -> np.ndarray:
    """[LONGEST, 2] by steps taken: 1 / (1 - beta_1^n) and sqrt(1 / (1 - beta_2^n)); a table saves two exponentials a row."""
    n = np.arange(1, LONGEST)
    table = np.ones((LONGEST, 2), np.float32)
    table[1:, 0], table[1:, 1] = 1 / (1 - BETA1**n), np.sqrt(1 / (1 - BETA2**n))
    return table


def step_rows(
    value: Tensor, mean: Tensor, square: Tensor, counts: Tensor, rows: Tensor, stepped: Tensor, gradient: Tensor, rates: Tensor
) -> None:
    """See ``reference.step_rows``."""
    arrays = (t.numpy() for t in (value, mean, square, counts, rows, stepped, gradient.contiguous(), rates))
    _step(*arrays, _corrections())
