"""Maps between their pixels."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.interpolation import sample_map


def test_sampling_is_exact_on_a_ramp_and_continues_the_border():
    ramp = pixel_grid(40, 30)  # the value at a pixel is its own position
    points = np.array([[0.5, 0.5], [10.25, 7.75], [39.5, 29.5], [100.0, -5.0]])
    expected = np.array([[0.5, 0.5], [10.25, 7.75], [39.5, 29.5], [39.5, 0.5]])
    np.testing.assert_allclose(sample_map(ramp, points), expected, atol=1e-4)


@pytest.mark.parametrize("count", [0, 1, 16384, 16385, 40000])
def test_sampling_takes_any_number_of_points(count):
    ramp = pixel_grid(40, 30)
    points = np.random.default_rng(1).uniform([0.5, 0.5], [39.5, 29.5], (count, 2))
    assert sample_map(ramp[..., 0], points).shape == (count, 1)
    np.testing.assert_allclose(sample_map(ramp, points), points, atol=0.02)
