from __future__ import annotations

import numpy as np

from flowsplat.priors.tracks.agreement import compute_agreed_motion

A = np.array([[0.02, -0.1], [0.1, 0.01]])


def points_and_motions(count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    points = np.random.default_rng(0).uniform(0, 100, (count, 2))
    return points, points @ A.T + [3, -2]


def test_an_affine_motion_is_found_among_strays():
    points, motions = points_and_motions()
    strays = np.arange(0, 200, 5)
    wrong = motions.copy()
    wrong[strays] += np.random.default_rng(1).normal(0, 10, (len(strays), 2))
    motion, gradient, spread = compute_agreed_motion(points, wrong, np.ones(200), np.zeros(200, int), 40.0)
    inner = (np.abs(points - 50) < 35).all(1)
    error = np.linalg.norm(motion - motions, axis=1)[inner]
    assert np.median(error) < 0.1
    assert error.max() < 1.5  # where most of the nearest are strays
    assert np.median(np.abs(gradient[inner] - A)) < 0.03
    assert np.median(spread) < 0.3


def test_a_point_is_not_its_own_witness():
    points, motions = points_and_motions()
    motions[17] += 9
    motion, _, _ = compute_agreed_motion(points, motions, np.ones(200), np.zeros(200, int), 40.0)
    assert np.linalg.norm(motion[17] - motions[17]) > 10


def test_only_believed_neighbors_of_the_same_kind_are_asked():
    points, motions = points_and_motions()
    labels = (np.arange(200) % 2).astype(int)
    motions[labels == 1] = 7
    weights = np.ones(200)
    weights[::4] = 0
    motions[::4] = 99
    motion, _, spread = compute_agreed_motion(points, motions, weights, labels, 40.0)
    np.testing.assert_allclose(motion[labels == 1], 7, atol=1e-3)
    assert np.abs(motion[labels == 0]).max() < 20
    labels[:3] = 5
    spread = compute_agreed_motion(points, motions, weights, labels, 40.0)[2]
    assert np.isinf(spread[:3]).all()
    assert np.isinf(compute_agreed_motion(points, motions, np.ones(200), np.zeros(200, int), 1e-3)[2]).all()
