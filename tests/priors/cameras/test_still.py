from __future__ import annotations

import cv2
import numpy as np
import pytest

from flowsplat.priors.cameras import CameraOptions, camera_stage
from flowsplat.priors.cameras.still import MIN_EDGES_IN_PLACE, MIN_PARTS_IN_PLACE, edges_in_place, stands_still
from tests.priors.cameras.test_stage import scene_of, texture

SIZE = 120, 200


def walkers(frames: int, camera: float = 0.0, dull: int = 4, seed: int = 0) -> list[np.ndarray]:
    """Return images of five figures who walk at their own speeds before a wall; the camera moves by so many pixels a frame."""
    rng = np.random.default_rng(seed)
    wall = texture(SIZE[0], SIZE[1] + 40, seed=9) // dull + (255 - 255 // dull) // 2
    figures = [(texture(85, 20, seed=k), 8 + 40 * k, rng.uniform(0.6, 1.4) * (-1) ** k) for k in range(5)]
    shown = []
    for t in range(frames):
        shift = np.float32([[1, 0, -camera * t], [0, 1, 0]])
        image = cv2.warpAffine(wall, shift, SIZE[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        for front, start, speed in figures:
            moved = np.float32([[1, 0, start + (speed - camera) * t], [0, 1, 30]])
            part = cv2.warpAffine(np.dstack([front, np.full(front.shape[:2], 255, np.uint8)]), moved, SIZE[::-1])
            image = np.where(part[..., 3:] > 127, part[..., :3], image)
        shown.append(image)
    return shown


def parts_in_place(frames: list[np.ndarray]) -> float:
    grays = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames])
    return float((edges_in_place(grays) >= MIN_EDGES_IN_PLACE).mean())


def test_a_camera_before_which_most_moves_stands_still(tmp_path):
    scene = scene_of(tmp_path / "scene", walkers(24))
    assert stands_still(scene, range(24))
    camera_stage(scene, CameraOptions())
    assert scene.prior("cameras")["motion"] == "static"
    for camera in scene.cameras:
        np.testing.assert_array_equal(camera.viewmat, np.eye(4))


@pytest.mark.parametrize("speed", [0.2, 0.5, 2.0])
def test_a_camera_that_moves_does_not(speed):
    assert parts_in_place(walkers(24, camera=speed)) < 0.5 * MIN_PARTS_IN_PLACE


def test_noise_and_compression_move_no_edges():
    frames, rng = walkers(24, dull=1), np.random.default_rng(1)
    noisy = [np.clip(frame + rng.normal(0, 3, frame.shape), 0, 255).astype(np.uint8) for frame in frames]
    packed = [cv2.imdecode(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 75])[1], cv2.IMREAD_COLOR) for frame in noisy]
    assert parts_in_place(packed) >= MIN_PARTS_IN_PLACE


def test_bars_and_a_hood_in_front_of_a_camera_that_moves_are_not_the_scene():
    frames = walkers(24, camera=2.0)
    for frame in frames:
        frame[80:100] = texture(20, SIZE[1], seed=7)
        frame[:20] = frame[-20:] = 0
    assert parts_in_place(frames) < MIN_PARTS_IN_PLACE


def test_images_without_edges_do_not_tell(tmp_path):
    flat = [np.full((*SIZE, 3), 128, np.uint8)] * 6
    assert len(edges_in_place(np.zeros((6, *SIZE), np.uint8))) == 0
    scene = scene_of(tmp_path / "scene", flat)
    assert not stands_still(scene, range(6))
    assert not stands_still(scene, [0])
    assert not stands_still(scene, [])
