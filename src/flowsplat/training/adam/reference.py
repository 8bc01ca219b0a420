"""The oracle: one Adam step for some rows of a parameter, in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


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
