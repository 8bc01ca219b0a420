"""One Adam step for some rows of a parameter. Oracle: ``reference``."""

from __future__ import annotations

import math

import numpy as np
from numba import float32, njit, prange
from torch import Tensor

from flowsplat.training.adam.reference import BETA1, BETA2, EPSILON

B1, B2, EPS, ONE = np.float32(BETA1), np.float32(BETA2), np.float32(EPSILON), np.float32(1)
LOG_B1, LOG_B2 = math.log(BETA1), math.log(BETA2)


@njit(parallel=True, fastmath={"reassoc", "contract", "nsz"}, cache=True, error_model="numpy")
def _step(value, mean, square, counts, rows, gradient, rates):
    for a in prange(len(rows)):
        i = rows[a]
        correct_m = float32(1.0 / (1.0 - math.exp(counts[i] * LOG_B1)))
        correct_v = float32(1.0 / (1.0 - math.exp(counts[i] * LOG_B2)))
        for d in range(gradient.shape[1]):
            g = gradient[a, d]
            m = B1 * mean[i, d] + (ONE - B1) * g
            v = B2 * square[i, d] + (ONE - B2) * g * g
            mean[i, d] = m
            square[i, d] = v
            value[i, d] -= rates[d] * (m * correct_m) / (math.sqrt(v * correct_v) + EPS)


def step_rows(
    value: Tensor, mean: Tensor, square: Tensor, counts: Tensor, rows: Tensor, gradient: Tensor, rates: Tensor
) -> None:
    """See ``reference.step_rows``."""
    _step(*(t.numpy() for t in (value, mean, square, counts, rows, gradient.contiguous(), rates)))
