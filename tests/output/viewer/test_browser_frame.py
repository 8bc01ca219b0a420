"""Cameras there and back."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.geometry import Camera, Similarity
from flowsplat.output.viewer.browser_frame import SCENE_DEPTH, BrowserFrame, Pose

RANDOM = np.random.default_rng(3)
SIMILARITY = Similarity(0.2, Rotation.random(rng=RANDOM).as_matrix(), RANDOM.normal(size=3))


def some_camera() -> Camera:
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.random(rng=RANDOM).as_matrix()
    viewmat[:3, 3] = RANDOM.normal(size=3)
    return Camera(viewmat, np.array([[70.0, 0, 40], [0, 70, 30], [0, 0, 1]]), 80, 60)


def test_a_camera_comes_back():
    browser, camera = BrowserFrame(SIMILARITY), some_camera()
    back = browser.camera(browser.pose(camera), 80, 60)
    np.testing.assert_allclose(back.viewmat, camera.viewmat, atol=1e-9)
    np.testing.assert_allclose(back.K, camera.K, atol=1e-9)


def test_the_browser_sees_what_the_camera_sees():
    """A point straight up in the image is up for the browser's axes, and the median depth is SCENE_DEPTH."""
    browser, camera = BrowserFrame(SIMILARITY), some_camera()
    pose = browser.pose(camera)
    point = camera.unproject(np.array([40.0, 10.0]), np.array(5.0))  # 5 = 1 / 0.2: the median depth
    there = browser.from_scene.points(point)
    axes = Rotation.from_quat(pose.wxyz, scalar_first=True).as_matrix()
    seen = (there - pose.position) @ axes
    np.testing.assert_allclose(seen[2], SCENE_DEPTH)
    assert abs(seen[0]) < 1e-9
    np.testing.assert_allclose(seen[1] / seen[2], -20 / 70)
    np.testing.assert_allclose(np.tan(pose.fov / 2), 30 / 70)
    np.testing.assert_allclose(pose.forward, axes[:, 2])


def test_a_wider_window_sees_more_at_the_sides():
    browser = BrowserFrame(Similarity())
    pose = Pose(np.array([1.0, 0, 0, 0]), np.zeros(3), np.pi / 2)
    narrow, wide = browser.camera(pose, 60, 60), browser.camera(pose, 120, 60)
    assert narrow.K[0, 0] == wide.K[0, 0]
    assert wide.K[0, 2] == 60
