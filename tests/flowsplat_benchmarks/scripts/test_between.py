"""The benchmark of what moves between two training frames sorts pixels and adds up their errors."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat_benchmarks.scripts import between
from flowsplat_benchmarks.scripts.between import Kinds, errors, kinds_of, table
from flowsplat_benchmarks.worlds import draw_world


def test_errors_are_those_of_the_pixels_of_a_kind():
    inside = np.zeros((4, 5), bool)
    inside[1, 1:4] = True
    kinds = Kinds(inside, np.array([0.5, 2.0, 9.0]), np.array([3.0, 5.0, 20.0]), np.array([0.1, 0.4, 2.0]))
    target, image = np.zeros((4, 5, 3)), np.zeros((4, 5, 3))
    image[1, 1:4] = np.array([0.1, 0.2, 0.4])[:, None]
    image[0] = 1.0  # outside
    found = errors(image, target, kinds)
    assert found["all"] == (pytest.approx(0.21), 3)
    assert found["speed 6 to inf"] == (pytest.approx(0.16), 1)
    assert found["thickness 4 to 8"] == (pytest.approx(0.04), 1)
    assert found["blur 0 to 0.5"] == (pytest.approx(0.05), 2)
    lines = table([{"held out": found}, {"held out": found}]).splitlines()
    assert lines[2] == f"| all | 1.00 | {-10 * np.log10(0.07):.2f} |"
    assert "| speed 6 to inf | 0.33 | 7.96 |" in lines


def test_limbs_of_a_dancer_are_thinner_than_its_trunk_and_faster():
    world = draw_world(4, 160, 90, 24, dancers=True)
    kinds = kinds_of(world, 9)
    thin = kinds.thickness < np.percentile(kinds.thickness, 30)
    assert 1 < kinds.thickness.min() < 8
    assert np.percentile(kinds.speed[thin], 90) > np.median(kinds.speed)
    assert between.settings(50).iterations == 50
