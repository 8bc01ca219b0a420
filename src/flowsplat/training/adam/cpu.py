"""Take one Adam step for some rows of a parameter. Oracle: ``reference``."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from flowsplat.common.kernels import kernel
from flowsplat.common.threads import parallel_for
from flowsplat.training.adam.reference import BETA1, BETA2, EPSILON, correction_table

B1, B2, EPS, ONE = np.float32(BETA1), np.float32(BETA2), np.float32(EPSILON), np.float32(1)


@kernel
def _step(begin, end, value, mean, square, counts, rows, stepped, gradient, rates, corrections):
    last = len(corrections) - 1
    for a in range(begin, end):
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


def step_rows(
    value: Tensor, mean: Tensor, square: Tensor, counts: Tensor, rows: Tensor, stepped: Tensor, gradient: Tensor, rates: Tensor
) -> None:
    """See ``reference.step_rows``."""
    arrays = (t.numpy() for t in (value, mean, square, counts, rows, stepped, gradient.contiguous(), rates))
    parallel_for(_step, len(rows), *arrays, correction_table())
