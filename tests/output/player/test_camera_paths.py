"""Camera paths of the player."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowsplat.geometry.paths import CameraPath, orbit
from flowsplat.output.player.camera_paths import LOOP_PHASES, PATH_SAMPLES, camera_paths, sample_path
from flowsplat.output.videos.amplitudes import LoopWidths
from flowsplat.output.videos.options import RenderOptions
from flowsplat.output.videos.paths import PATHS
from tests.output.small import small_cameras, small_model, small_player, small_times
from tests.output.tiny import FPS, FRAMES, OBJECT, WALL, tiny_cameras, tiny_model

TURNED = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])


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
    own, steady = np.array(found["clipPath"]), np.array(by_name(found)["stabilized"]["rows"])
    heights = [rows[::PATH_SAMPLES, 2] for rows in (own, steady)]
    assert np.abs(np.diff(heights[1], 2)).mean() < 0.2 * np.abs(np.diff(heights[0], 2)).mean()
    np.testing.assert_allclose(steady[:, 0], own[:, 0])
    assert 1 < steady[0, 8] / own[0, 8] <= 1 / 0.7, "cropped, by as much as it needs"


@pytest.mark.parametrize(("objects", "depth"), [(1, OBJECT / WALL), (0, 1.0)])
def test_the_subject_is_what_moves(objects, depth):
    """What is at its depth stays where it is: a quarter of a turn shifts the camera by half the distance of the eyes, and back."""
    model, times = tiny_model(objects), (np.arange(FRAMES) / FPS).tolist()
    offsets = np.array(by_name(camera_paths(model, times, tiny_cameras((64, 48))))["wiggle"]["offsets"])
    quarter = offsets[:, LOOP_PHASES // 4]
    np.testing.assert_allclose(quarter[:, 4], RenderOptions.eye_distance / 2, atol=1e-6)
    np.testing.assert_allclose(quarter[:, 4] / quarter[:, 9], depth, rtol=0.05)


def test_offsets_are_those_of_the_clips_camera():
    """Taken back they are the cameras of the path, in the coordinates of the player."""
    model, times = small_model(rotation=TURNED), small_times()
    cameras = small_cameras(model)
    found = by_name(camera_paths(model, times, cameras, widths=LoopWidths(angle=12.0)))["bullet"]
    assert found["seconds"] == 5
    assert len(found["offsets"]) == 1, "they are the same at any time"
    own = model.similarity.camera(cameras[4])
    expected = orbit(own, 1.0, LOOP_PHASES, 12.0)
    for row, there in zip(found["offsets"][0], expected, strict=True):
        turned = Rotation.from_quat(np.roll(row[:4], -1)).as_matrix() @ own.viewmat[:3, :3]
        np.testing.assert_allclose(turned, there.viewmat[:3, :3], atol=1e-5)
        np.testing.assert_allclose(own.center + own.viewmat[:3, :3].T @ row[4:7], there.center, atol=1e-5)
        np.testing.assert_allclose(row[7:], [1, 1, 0, 0], atol=1e-6)


def test_the_menu_has_what_is_registered(tmp_path, climb):
    """The page needs no line for it."""
    text = small_player(tmp_path / "player.html", small_model()).read_text()
    menu = re.findall(r'<option value="path:([^"]+)">([^<]+)</option>', text)
    assert menu[:4] == [("stabilized", "steadied"), ("bullet", "bullet time"), ("dolly", "dolly zoom"), ("wiggle", "wiggle")]
    assert ("climb", "up &amp; away") in menu
    assert [name for name, _ in menu] == [entry.name for entry in PATHS.entries() if entry.value.is_in_page]
    about = json.loads(re.search(r'<script id="about" type="application/json">(.*?)</script>', text)[1])
    rows = np.array(by_name(about)["climb"]["rows"])
    np.testing.assert_allclose(rows[:, 2], np.array(about["clipPath"])[:, 2] - climb, atol=1e-5)


def by_name(about: dict) -> dict:
    """The paths of a page by their names."""
    return {path["name"]: path for path in about["paths"]}
