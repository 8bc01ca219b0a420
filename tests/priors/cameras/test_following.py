"""Followed points stay where they were first seen on the surface."""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.priors.cameras.following import _Surroundings
from tests.priors.tracks.textures import texture

MIDDLE = np.array([90.0, 70.0])


def frame(image: np.ndarray, t: int) -> tuple[np.ndarray, np.ndarray]:
    """The surface as seen later, slowly nearer and turned; and the map [2, 3] of its points."""
    turn, scale = np.radians(0.4 * t), 1 + 0.004 * t
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    matrix = np.array([[c, -s], [s, c]])
    full = np.concatenate([matrix, (MIDDLE - matrix @ MIDDLE + [0.3 * t, -0.2 * t])[:, None]], 1)
    return cv2.warpAffine(image, full, image.shape[::-1], flags=cv2.INTER_CUBIC).astype(np.float32), full


def test_drift_does_not_add_up():
    image, rng = texture(140, 180), np.random.default_rng(0)
    start = MIDDLE + np.stack(np.meshgrid([-30.0, -10, 10, 30], [-24.0, -8, 8, 24]), -1).reshape(-1, 2)
    around = _Surroundings()
    around.add(image.astype(np.float32), (start + 0.5).astype(np.float32), 0)
    points, drifting = start.copy(), start.copy()
    for t in range(1, 31):
        shifted, matrix = frame(image, t)
        true = start @ matrix[:, :2].T + matrix[:, 2]
        before = frame(image, t - 1)[1]
        step = true - (start @ before[:, :2].T + before[:, 2])
        # Each step is a little wrong, and always the same way.
        wrong = step + [0.03, 0.02] + rng.normal(0, 0.02, start.shape)
        points = around.find(shifted, (points + wrong + 0.5).astype(np.float32), t) - 0.5
        drifting = drifting + wrong
    assert np.median(np.linalg.norm(drifting - true, axis=1)) > 0.8
    assert np.median(np.linalg.norm(points - true, axis=1)) < 0.12


def test_what_looks_different_stays_where_it_was_followed_to():
    image = texture(140, 180)
    points = (MIDDLE + [[0.0, 0.0], [20.0, 10.0]]).astype(np.float32)
    around = _Surroundings()
    around.add(image.astype(np.float32), points, 0)
    np.testing.assert_array_equal(around.find(texture(140, 180, seed=1).astype(np.float32), points, 1), points)
    around.keep(np.array([1]))
    assert around.find(image.astype(np.float32), points[1:], 2).shape == (1, 2)
