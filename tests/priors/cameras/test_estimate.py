from __future__ import annotations

import numpy as np
import pytest

from flowsplat.geometry.similarity import path_errors
from flowsplat.priors.cameras.estimate import estimate
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.pieces import find_breaks
from tests.marks import slow
from tests.priors.cameras.worlds import FOCAL, HEIGHT, WIDTH, cameras_of, observed, path, world


@pytest.mark.parametrize(("objects", "solver"), [slow(0, "own"), slow(120, "own"), (120, "global")])
def test_a_moving_camera_is_recovered_although_some_points_move(objects, solver):
    cameras, rng = path(24), np.random.default_rng(7)
    points = np.repeat(world(400)[None], 24, 0)
    start = rng.uniform([-2, -1, 3], [1, 1, 4], (objects, 3))
    times = np.linspace(0, 1, 24)[:, None, None]
    moving = start + times * np.array([1.5, 0.3, 0.5]) + 0.2 * np.sin(6 * times)
    positions = Observations.of(observed(cameras, np.concatenate([points, moving], 1), 0.1))
    found = estimate(positions, WIDTH, HEIGHT, None, solver)
    assert found.motion == "free"
    assert found.unplaced == []
    assert find_breaks(positions, range(24)) == []
    errors = path_errors(cameras_of(found.fit.state), cameras)
    assert errors["path"] < 0.003
    assert errors["rotation"] < 0.05
    assert errors["focal"] < 0.01
    assert np.median(found.fit.errors) < 0.2
    again = estimate(positions, WIDTH, HEIGHT, None, solver)
    np.testing.assert_array_equal(again.fit.state.translations, found.fit.state.translations)


def test_a_given_focal_length_is_kept():
    cameras = path(10)
    found = estimate(Observations.of(observed(cameras, world(300), 0.1)), WIDTH, HEIGHT, FOCAL)
    assert found.fit.state.focal == FOCAL
    assert path_errors(cameras_of(found.fit.state), cameras)["path"] < 0.005


def test_a_turning_camera_is_recognized_with_its_focal_length():
    cameras = path(16, travel=0.0)
    found = estimate(Observations.of(observed(cameras, world(500), 0.08)), WIDTH, HEIGHT, None)
    assert found.motion == "rotation"
    assert (found.fit.state.translations == 0).all()
    errors = path_errors(cameras_of(found.fit.state), cameras)
    assert errors["rotation"] < 0.1
    assert errors["focal"] < 0.02
