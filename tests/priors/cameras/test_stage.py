from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.similarity import path_errors
from flowsplat.priors.cameras import CameraOptions, camera_stage, straightening
from flowsplat.priors.cameras.bundle import rays
from flowsplat.priors.given import GivenPriors
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes import Scene
from tests.priors.test_nasty_clips import ROOM, World, travel


def texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width, 3)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def scene_of(folder: Path, frames: list[np.ndarray], holdout: int | None = None) -> Scene:
    height, width = frames[0].shape[:2]
    scene = Scene.create(
        folder, name="s", source="", width=width, height=height, timestamps=range(len(frames)), holdout=holdout,
        source_fps=1,
    )  # fmt: skip
    for i, frame in enumerate(frames):
        scene.write_frame(i, frame)
    return scene


def test_a_camera_on_a_tripod_stands_still_although_something_moves(tmp_path):
    back, front, frames = texture(120, 160), texture(40, 40, seed=2), []
    for i in range(6):
        frame = back.copy()
        frame[30:70, 20 + 5 * i : 60 + 5 * i] = front
        frames.append(frame)
    scene = scene_of(tmp_path / "scene", frames)
    camera_stage(scene, CameraOptions())
    prior = scene.prior("cameras")
    assert prior["static"]
    assert "stands still" in prior["verdict"]
    assert len(scene.cameras) == 6
    for camera in scene.cameras:
        np.testing.assert_array_equal(camera.viewmat, np.eye(4))


@pytest.mark.parametrize(("count", "size"), [(2, (48, 64)), (3, (48, 64)), (3, (12, 16)), (2, (4, 4))])
def test_short_and_tiny_clips_have_finite_cameras(tmp_path, count, size):
    big = texture(size[0] + 20, size[1] + 20)
    frames = [big[10 : 10 + size[0], 10 + 2 * i : 10 + 2 * i + size[1]] for i in range(count)]
    scene = scene_of(tmp_path / "scene", frames)
    camera_stage(scene, CameraOptions())
    assert len(scene.cameras) == count
    assert all(camera.is_valid for camera in scene.cameras)
    json.dumps(scene.prior("cameras"), allow_nan=False)


def test_blank_images_say_so(tmp_path):
    scene = scene_of(tmp_path / "scene", [np.full((48, 64, 3), 90, np.uint8)] * 3)
    camera_stage(scene, CameraOptions())
    assert scene.prior("cameras")["static"]
    assert "Nothing in the images could be followed" in scene.prior("cameras")["verdict"]


@pytest.mark.parametrize("focal", [0.0, -3.0, float("nan"), float("inf")])
def test_a_senseless_focal_length_is_refused(tmp_path, focal):
    scene = scene_of(tmp_path / "scene", [texture(48, 64)] * 2)
    with pytest.raises(InputError, match="focal length"):
        camera_stage(scene, CameraOptions(focal=focal))


@pytest.mark.slow
def test_the_rendered_workshop(tmp_path):
    if "FLOWSPLAT_DATA" not in os.environ:
        pytest.skip("FLOWSPLAT_DATA is not set")
    folder = Path(os.environ["FLOWSPLAT_DATA"]) / "rig" / "workshop"
    truth = json.loads((folder / "cameras.json").read_text())
    frames = [cv2.imread(str(p))[..., ::-1] for p in sorted((folder / "rgb").glob("*.png"))]
    scene = scene_of(tmp_path / "scene", [np.ascontiguousarray(f) for f in frames])
    camera_stage(scene, CameraOptions())
    true = [Camera(np.array(m), np.array(truth["K"]), truth["width"], truth["height"]) for m in truth["w2c"]]
    errors = path_errors(scene.cameras, true)
    assert errors["path"] < 0.005
    assert errors["rotation"] < 0.05
    assert errors["focal"] < 0.02
    assert scene.prior("cameras")["reprojection_px"] < 0.15


# -- the lens


def bent_clip(distortion: float, count: int = 12) -> tuple[list[np.ndarray], list[Camera]]:
    """Frames of a room, taken through a lens with this k1, and the pinhole cameras behind it."""
    cameras = travel(count, 1.2, size=(320, 200))
    focal, middle = cameras[0].K[0, 0], cameras[0].K[:2, 2]
    bent = (pixel_grid(320, 200) - middle) / focal
    pinhole = rays(bent * focal, focal, distortion) * focal + middle - 0.5
    world = World(ROOM, width=320)
    frames = [
        cv2.remap(world.image(camera), pinhole.astype(np.float32), None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        for camera in cameras
    ]
    return frames, cameras


@pytest.fixture(scope="module")
def through_a_lens() -> tuple[list[np.ndarray], list[Camera]]:
    return bent_clip(-0.15)


def test_a_bent_clip_is_straightened(tmp_path, through_a_lens):
    frames, cameras = through_a_lens
    scene = scene_of(tmp_path / "plain", frames, holdout=5)
    camera_stage(scene, CameraOptions())
    assert (scene.any_frame(3) == frames[3]).all()
    pinhole = scene.prior("cameras")["reprojection_px"]
    scene = scene_of(tmp_path / "straight", frames, holdout=5)
    for i in scene.train_frames:
        scene.write_mask(i, np.zeros((200, 320), np.uint8))
    camera_stage(scene, CameraOptions(distortion="radial"))
    prior = scene.prior("cameras")
    assert prior["distortion"] == pytest.approx(-0.15, rel=0.1)
    assert prior["reprojection_px"] < 0.9 * pinhole
    assert "frames and given masks were straightened" in prior["verdict"]
    assert "straightened" in scene.info.notes[-1]
    errors = path_errors(scene.cameras, cameras)
    assert errors["path"] < 0.02
    assert errors["rotation"] < 0.3
    # What the pinhole at that place would have seen, but for the wider or narrower view: how a lens bends an image is known better
    # than its focal length, which is compared apart.
    assert scene.lens.K[0, 0] == pytest.approx(cameras[0].K[0, 0], rel=0.02)
    zoom = scene.lens.zoom
    grid = ((pixel_grid(320, 200) - [160, 100]) / zoom + [160, 100] - 0.5).astype(np.float32)
    for i in (0, 4, 9):
        true = cv2.remap(World(ROOM, width=320).image(cameras[i]), grid, None, cv2.INTER_CUBIC)
        inside = np.zeros((200, 320), bool)
        inside[20:-20, 20:-20] = True
        difference = np.abs(scene.any_frame(i).astype(float) - true)[inside].mean()
        assert difference < 0.5 * np.abs(frames[i].astype(float) - true)[inside].mean()


def test_straightening_goes_on_after_a_kill_and_is_not_done_twice(tmp_path, through_a_lens, monkeypatch):
    frames = through_a_lens[0][:8]
    whole = scene_of(tmp_path / "whole", frames)
    camera_stage(whole, CameraOptions(distortion="radial"))
    scene = scene_of(tmp_path / "killed", frames)

    def dying(scene, change):
        raise KeyboardInterrupt

    monkeypatch.setattr(straightening, "replace_images", dying)
    with pytest.raises(KeyboardInterrupt):
        camera_stage(scene, CameraOptions(distortion="radial"))
    monkeypatch.undo()
    scene = Scene(tmp_path / "killed")
    assert scene.prior("cameras") is None
    camera_stage(scene, CameraOptions(distortion="radial"))
    assert scene.info == whole.info
    for i in range(scene.num_frames):
        np.testing.assert_array_equal(scene.any_frame(i), whole.any_frame(i))
    scene.forget_priors(["cameras"])
    camera_stage(scene, CameraOptions(distortion="radial"))
    assert scene.prior("cameras")["distortion"] == 0
    np.testing.assert_array_equal(scene.any_frame(2), whole.any_frame(2))


def test_what_was_made_for_the_bent_images_forbids_to_straighten_them(tmp_path):
    scene = scene_of(tmp_path / "scene", [texture(48, 64)] * 3)
    scene.finish_prior("flow", method="given")
    with pytest.raises(InputError, match="Flow of s"):
        camera_stage(scene, CameraOptions(distortion="radial"))
    scene = scene_of(tmp_path / "true", [texture(48, 64)] * 3)
    scene.create_truth()
    with pytest.raises(InputError, match="pinholes"):
        camera_stage(scene, CameraOptions(distortion="radial"))


def test_a_camera_that_stands_still_shows_no_lens(tmp_path):
    scene = scene_of(tmp_path / "scene", [texture(48, 64)] * 3)
    camera_stage(scene, CameraOptions(distortion="radial"))
    assert "No distortion of the lens shows" in scene.prior("cameras")["verdict"]
    assert scene.prior("cameras")["options"] == {"focal": None, "solver": "auto", "distortion": "radial"}
    assert scene.info.lens is None


@pytest.mark.parametrize(
    "options",
    [
        PriorsOptions(given=GivenPriors(flow=Path("flow")), cameras=CameraOptions(distortion="radial")),
        PriorsOptions(priors="true", cameras=CameraOptions(distortion="radial")),
    ],
)
def test_files_for_the_bent_images_are_refused_at_once(tmp_path, options):
    scene = scene_of(tmp_path / "scene", [texture(48, 64)] * 3)
    with pytest.raises(InputError, match="leave out --cameras"):
        prepare_priors(scene, options)
