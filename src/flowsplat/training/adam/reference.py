"""The oracle: one Adam step for some rows of a parameter, in plain torch."""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15
"""Decay of the first and of the second moment, and what keeps the division finite (docs/method/training.md, has the last)."""
MAX_CORRECTED_STEPS = 1 << 15
"""Steps after which the bias correction of the second moment is 1 in float32."""


@functools.cache
def correction_table() -> np.ndarray:
    """Return [MAX_CORRECTED_STEPS, 2] for the kernels, by steps taken: 1 / (1 - beta_1^n) and sqrt(1 / (1 - beta_2^n))."""
    n = np.arange(1, MAX_CORRECTED_STEPS)
    table = np.ones((MAX_CORRECTED_STEPS, 2), np.float32)
    table[1:, 0], table[1:, 1] = 1 / (1 - BETA1**n), np.sqrt(1 / (1 - BETA2**n))
    return table


def step_rows(
    value: Tensor, mean: Tensor, square: Tensor, counts: Tensor, rows: Tensor, stepped: Tensor, gradient: Tensor, rates: Tensor
) -> None:
    """In place, for value, mean and square [N, D]: rows [A] where stepped [A] get one step along gradient [A, D] at rates [D].

    counts [N] are the steps that each row has taken, this one included.
    """
    rows, gradient = rows[stepped], gradient[stepped]
    count = counts[rows].double()[:, None]  # 1 - beta^count loses its digits in float32
    m = BETA1 * mean[rows] + (1 - BETA1) * gradient
    v = BETA2 * square[rows] + (1 - BETA2) * gradient * gradient
    mean[rows], square[rows] = m, v
    corrected_m, corrected_v = m / (1 - BETA1**count), v / (1 - BETA2**count)
    value[rows] -= (rates * corrected_m / (torch.sqrt(corrected_v) + EPSILON)).to(value.dtype)
