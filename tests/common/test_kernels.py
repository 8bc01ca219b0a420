"""The elementary functions of the kernels against NumPy's."""

from __future__ import annotations

import numpy as np
from numba import njit

from flowsplat.common import kernels


@njit
def _exp(values, out):
    for i in range(len(values)):
        out[i] = kernels.exp(values[i])


@njit
def _log(values, out):
    for i in range(len(values)):
        out[i] = kernels.log(values[i])


def test_the_exponential_is_right_to_the_last_digits():
    x = np.concatenate([np.linspace(-87, 88, 100_001), np.linspace(-1, 1, 100_001)]).astype(np.float32)
    found = np.empty_like(x)
    _exp(x, found)
    assert np.abs(found / np.exp(x.astype(np.float64)) - 1).max() < 3e-7


def test_the_exponential_is_finite_and_right_wherever_it_is_a_float32():
    """Up to the last float32 whose exponential is one, and from the first one that is not clamped."""
    top, bottom = np.float32(88.72283), np.float32(-87.3)
    ends = [np.concatenate([np.linspace(a, b, 100_001), [b]]).astype(np.float32) for a, b in ((88.3, top), (bottom, -86.9))]
    x = np.concatenate(ends)
    found = np.empty_like(x)
    _exp(x, found)
    with np.errstate(over="raise"):
        assert np.isfinite(np.exp(top))
    with np.errstate(over="ignore"):
        assert np.isinf(np.exp(np.nextafter(top, np.float32(np.inf))))
    assert np.isfinite(found).all()
    assert np.abs(found / np.exp(x.astype(np.float64)) - 1).max() < 3e-7


def test_the_exponential_of_extremes():
    x, found = np.array([-np.inf, -1000, 1000, np.inf, np.nan, 0], np.float32), np.empty(6, np.float32)
    _exp(x, found)
    assert (found[:2] >= 0).all()
    assert (found[:2] < 2e-38).all()
    assert (found[2:4] > 3.402e38).all()
    assert np.isfinite(found[:4]).all()
    assert np.isnan(found[4])
    assert found[5] == 1


def test_the_logarithm_is_right_to_the_last_digits():
    x = np.concatenate([np.exp(np.linspace(-80, 80, 100_001)), np.linspace(0.5, 2, 100_001)]).astype(np.float32)
    found, exact = np.empty_like(x), np.log(x.astype(np.float64))
    _log(x, found)
    assert (np.abs(found - exact) / np.maximum(np.abs(exact), 1)).max() < 2e-7
