"""Camera paths of the player."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.geometry.paths import CameraPath
from flowsplat.output.player.camera_paths import PATH_SAMPLES, camera_paths, sample_path
from tests.output.small import small_cameras, small_model, small_times
from tests.output.tiny import FPS, FRAMES, OBJECT, WALL, tiny_cameras, tiny_model


def test_the_path_of_the_clip_is_exact_at_its_frames():
    model = small_model()
    path = np.array(sample_path(model, small_times(), small_cameras(model)))
    assert len(path) == PATH_SAMPLES * (len(small_times()) - 1) + 1
    for row, camera in zip(path[::PATH_SAMPLES], small_cameras(model), strict=True):
        np.testing.assert_allclose(row[1:4], model.similarity.camera(camera).center, atol=1e-6)
        np.testing.assert_allclose(row[8:], camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], atol=1e-5)
    between = CameraPath(small_times(), small_cameras(model)).at(float(np.mean(small_times()[2:4])))
    np.testing.assert_allclose(path[2 * PATH_SAMPLES + 2, 1:4], model.similarity.camera(between).center, atol=1e-6)


def test_the_steadied_path_shakes_less_and_shows_no_uncovered_border():
    model, times = tiny_model(1, half_width=1.8), (np.arange(FRAMES) / FPS).tolist()
    found = camera_paths(model, times, tiny_cameras((64, 48), shake=0.1))
    own, steady = np.array(found["clipPath"]), np.array(found["steadyPath"])
    heights = [rows[::PATH_SAMPLES, 2] for rows in (own, steady)]
    assert np.abs(np.diff(heights[1], 2)).mean() < 0.2 * np.abs(np.diff(heights[0], 2)).mean()
    np.testing.assert_allclose(steady[:, 0], own[:, 0])
    assert 1 < steady[0, 8] / own[0, 8] <= 1 / 0.7, "cropped, by as much as it needs"


@pytest.mark.parametrize(("objects", "depth"), [(1, OBJECT / WALL), (0, 1.0)])
def test_the_subject_is_what_moves(objects, depth):
    model, times = tiny_model(objects), (np.arange(FRAMES) / FPS).tolist()
    np.testing.assert_allclose(camera_paths(model, times, tiny_cameras((64, 48)))["subjectDepths"], depth, rtol=0.05)
