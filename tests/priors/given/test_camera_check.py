"""Given cameras are compared with the images: wrong readings of the same numbers are turned right, and wrong ones refused."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.given.camera_check import compute_misfit, match_frames
from flowsplat.priors.prepare import use_given
from flowsplat.scenes import Scene
from tests.priors.cameras.test_still import walkers
from tests.priors.test_nasty_clips import ROOM, World, travel, write

FRAMES = 24
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
Change = Callable[[Camera], Camera]


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    return travel(FRAMES, way=1.5, size=(256, 160))


@pytest.fixture
def scene(tmp_path: Path, frames: list[np.ndarray]) -> Scene:
    return write(tmp_path / "scene", frames)


@pytest.fixture(scope="module")
def frames(cameras: list[Camera]) -> list[np.ndarray]:
    world = World(ROOM, width=256)
    return [world.image(camera) for camera in cameras]


def give(scene: Scene, cameras: Sequence[Camera], folder: Path) -> str:
    (folder / "cameras.json").write_text(json.dumps([camera.to_json() for camera in cameras]))
    use_given(scene, GivenPriors(cameras=folder / "cameras.json"))
    return str((scene.prior("cameras") or {})["verdict"])


def posed(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda camera: replace(camera, viewmat=change(camera.viewmat))


def test_right_cameras_stay_as_they_are(scene, cameras, tmp_path):
    verdict = give(scene, cameras, tmp_path)
    assert "miss the images by 0." in verdict
    assert compute_misfit(cameras, match_frames(scene)) < 0.15
    for found, camera in zip(scene.cameras, cameras, strict=True):
        np.testing.assert_allclose(found.viewmat, camera.viewmat, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (posed(np.linalg.inv), "camera-to-world poses:"),
        (posed(lambda pose: FLIP @ pose), "world-to-camera poses with OpenGL's axes"),
        (posed(lambda pose: np.linalg.inv(FLIP @ pose)), "camera-to-world poses with OpenGL's axes"),
        (lambda camera: replace(camera, K=np.diag([2.5, 2.5, 1]) @ camera.K), "of images of another size"),
        (lambda camera: replace(camera, K=np.diag([0.4, 0.4, 1]) @ camera.K), "of images of another size"),
    ],
)
def test_other_readings_are_turned_right_and_said(scene, cameras, tmp_path, change: Change, said: str):
    verdict = give(scene, [change(camera) for camera in cameras], tmp_path)
    assert said in verdict
    assert "as they came they miss the images by" in verdict
    for found, camera in zip(scene.cameras, cameras, strict=True):
        np.testing.assert_allclose(found.viewmat, camera.viewmat, atol=1e-6)
        np.testing.assert_allclose(found.K, camera.K, rtol=1e-6)


def test_cameras_of_another_clip_are_refused_in_one_line_and_nothing_is_written(scene, cameras, tmp_path):
    rng = np.random.default_rng(0)
    others = [replace(camera, viewmat=camera.viewmat @ shifted(rng)) for camera in cameras]
    with pytest.raises(InputError, match="do not belong to these images") as error:
        give(scene, others, tmp_path)
    assert "\n" not in str(error.value)
    assert scene.prior("cameras") is None


def shifted(rng: np.random.Generator) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = rng.normal(0, 0.5, 3)
    return pose


def test_images_that_do_not_move_tell_nothing(cameras, tmp_path):
    still = [World(ROOM, width=256).image(cameras[0])] * 6
    scene = write(tmp_path / "still", still)
    assert list(match_frames(scene)) == []
    assert "miss" not in give(scene, cameras[:6], tmp_path)
    outside = [replace(camera, K=np.diag([2.5, 2.5, 1]) @ camera.K) for camera in cameras[:6]]
    scene = write(tmp_path / "again", still)
    with pytest.raises(InputError, match="principal point of camera 0"):
        give(scene, outside, tmp_path)


def test_a_turning_camera_is_judged_by_its_points(tmp_path):
    turning = travel(FRAMES, way=0.0, turn=0.3, size=(256, 160))
    world = World(ROOM, width=256)
    scene = write(tmp_path / "turning", [world.image(camera) for camera in turning])
    assert "miss the images by 0." in give(scene, turning, tmp_path)
    turned_back = [replace(camera, viewmat=np.linalg.inv(camera.viewmat)) for camera in turning]
    scene = write(tmp_path / "again", [world.image(camera) for camera in turning])
    assert "they are" in give(scene, turned_back, tmp_path)


def test_right_cameras_before_which_most_moves_are_not_refused(cameras, tmp_path):
    """Something in front hides most of the image and goes its own way."""
    near = World([*ROOM, (-0.5, -1.0, 1.0, 1.0, 2.0)], width=256)
    scene = write(tmp_path / "moving", [near.image(camera, (0.02 * t, 0.01 * t, 0)) for t, camera in enumerate(cameras)])
    assert "they miss the images by 0." in give(scene, cameras, tmp_path)


def test_a_camera_that_stands_still_before_which_most_moves_is_not_refused(tmp_path):
    frames = walkers(24)
    scene = write(tmp_path / "still", frames)
    height, width = frames[0].shape[:2]
    still = [Camera(np.eye(4), np.array([[180.0, 0, width / 2], [0, 180, height / 2], [0, 0, 1]]), width, height)] * 24
    assert "miss" not in give(scene, still, tmp_path)
