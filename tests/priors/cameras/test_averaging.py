from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.geometry.similarity import path_errors
from flowsplat.priors.cameras.averaging import Turn, average_rotations, pair_rotations, position_cameras, start_by_averaging
from flowsplat.priors.cameras.bundle import Reconstruction
from tests.priors.cameras.worlds import FOCAL, cameras_of, centered, observed, path, world


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[T] degrees between rotations, once both begin with the identity."""
    a, b = a @ a[0].T, b @ b[0].T
    return np.degrees(Rotation.from_matrix(a @ b.transpose(0, 2, 1)).magnitude())


def test_rotations_are_averaged_although_some_pairs_are_wrong():
    rng = np.random.default_rng(0)
    true = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.1, (20, 3)), 0)).as_matrix()
    turns = []
    for i in range(20):
        for j in range(i + 1, min(i + 6, 20)):
            wrong = rng.uniform() < 0.15 and j > i + 1
            noise = Rotation.from_rotvec(rng.normal(0, 1.0 if wrong else 0.002, 3)).as_matrix()
            turns.append(Turn(i, j, noise @ true[j] @ true[i].T, 1.0))
    found, reached = average_rotations(turns, 20)
    assert reached.all()
    assert angles(found, true).max() < 0.5


def test_frames_that_no_pair_joins_are_left_out():
    turns = [Turn(i, i + 1, np.eye(3), 1.0) for i in (0, 1, 2, 5)]
    assert average_rotations(turns, 8)[1].tolist() == [True] * 4 + [False] * 4
    assert not average_rotations([], 3)[1].any()


def test_positions_follow_from_rotations():
    cameras = path(12)
    positions, seen = centered(observed(cameras, world(300), 0.0))
    rotations = np.array([camera.viewmat[:3, :3] for camera in cameras])
    centers = position_cameras(rotations, positions, seen, FOCAL)
    translations = -np.einsum("tij,tj->ti", rotations, centers)
    found = cameras_of(Reconstruction(rotations, translations, FOCAL, np.zeros((0, 3))))
    assert path_errors(found, cameras)["path"] < 1e-4


def test_the_start_is_near_although_the_focal_length_is_not():
    cameras = path(20)
    positions, seen = centered(observed(cameras, world(400), 0.1))
    state, reached = start_by_averaging(positions, seen, 1.15 * FOCAL)
    assert reached.all()
    errors = path_errors(cameras_of(state), cameras)
    assert errors["path"] < 0.06
    assert errors["rotation"] < 2


def test_a_turning_camera_has_its_pairs_turned():
    cameras = path(10, travel=0.0)
    positions, seen = centered(observed(cameras, world(300), 0.1))
    true = np.array([camera.viewmat[:3, :3] for camera in cameras])
    for turn in pair_rotations(positions, seen, FOCAL):
        error = Rotation.from_matrix(turn.rotation @ true[turn.i] @ true[turn.j].T).magnitude()
        assert np.degrees(error) < 0.1


def test_too_little_to_go_on():
    positions, seen = centered(observed(path(5), world(6), 0.1))
    assert start_by_averaging(positions, seen, FOCAL) is None
