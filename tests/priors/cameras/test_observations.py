"""A list of observations against the table of positions that it stands for."""

import numpy as np
import pytest

from flowsplat.priors.cameras.observations import Observations

POINTS, CAMERAS = 7, 5


@pytest.fixture
def positions() -> np.ndarray:
    """[N, T, 2], NaN where not seen; one point is never seen."""
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, 100, (POINTS, CAMERAS, 2))
    positions[rng.random((POINTS, CAMERAS)) < 0.4] = np.nan
    positions[3] = np.nan
    return positions


def test_there_and_back(positions):
    seen = Observations.of(positions)
    np.testing.assert_array_equal(seen.dense(), positions)
    np.testing.assert_array_equal(seen.seen, np.isfinite(positions[..., 0]))
    np.testing.assert_array_equal(seen.counts, seen.seen.sum(1))
    assert len(seen) == seen.seen.sum()
    assert seen.dense(0.0)[3].tolist() == np.zeros((CAMERAS, 2)).tolist()


@pytest.mark.parametrize("points", [np.array([0, 2, 3, 6]), np.zeros(0, int), np.arange(POINTS) % 2 == 0])
def test_some_points(positions, points):
    np.testing.assert_array_equal(Observations.of(positions).of_points(points).dense(), positions[points])


@pytest.mark.parametrize("cameras", [np.array([1, 4]), np.zeros(0, int), np.arange(CAMERAS)])
def test_some_cameras(positions, cameras):
    np.testing.assert_array_equal(Observations.of(positions).of_cameras(cameras).dense(), positions[:, cameras])


def test_what_is_moved_out_of_sight_was_not_seen(positions):
    seen = Observations.of(positions)
    moved = np.where(seen.uv[:, :1] < 50, np.nan, seen.uv + 1)
    np.testing.assert_array_equal(seen.at(moved).dense(), np.where(positions[..., :1] < 50, np.nan, positions + 1))
    np.testing.assert_array_equal(seen.from_middle(100, 60).dense(), positions - [50, 30])


def test_by_camera(positions):
    seen = Observations.of(positions)
    rows = seen.by_camera()
    assert len(rows) == CAMERAS
    for t, each in enumerate(rows):
        there = np.isfinite(positions[:, t, 0])
        np.testing.assert_array_equal(seen.point[each], np.flatnonzero(there))
        np.testing.assert_array_equal(seen.uv[each], positions[there, t])
