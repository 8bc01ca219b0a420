from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.similarity import path_errors
from flowsplat.priors.cameras import CameraOptions, camera_stage
from flowsplat.priors.cameras.bundle import Observations, Reconstruction, adjust, residuals
from flowsplat.priors.cameras.estimate import estimate
from flowsplat.priors.cameras.growth import triangulate
from flowsplat.priors.cameras.pieces import find_breaks
from flowsplat.priors.cameras.refinement import place_points, ray_points
from flowsplat.priors.cameras.selection import GRID, choose_tracks
from flowsplat.scenes import Scene

WIDTH, HEIGHT, FOCAL = 640, 360, 500.0


def path(count: int, travel: float = 1.5) -> list[Camera]:
    """A gentle sideways path that also turns."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    cameras = []
    for s in np.linspace(0, 1, count):
        viewmat = np.eye(4)
        viewmat[:3, :3] = Rotation.from_rotvec([0.05 * np.sin(5 * s), -0.25 * s, 0.03 * s]).as_matrix()
        center = travel * np.array([s, 0.1 * np.sin(3 * s), 0.2 * s * s])
        viewmat[:3, 3] = -viewmat[:3, :3] @ center
        cameras.append(Camera(viewmat, K, WIDTH, HEIGHT))
    return cameras


def observed(cameras: list[Camera], points: np.ndarray, noise: float, seed: int = 0) -> np.ndarray:
    """Positions [N, T, 2], NaN outside the picture; ``points`` [N, 3] or moving [T, N, 3]."""
    rng = np.random.default_rng(seed)
    positions = np.full((points.shape[-2], len(cameras), 2), np.nan)
    for t, camera in enumerate(cameras):
        uv, depth = camera.project(points if points.ndim == 2 else points[t])
        uv = uv + rng.normal(0, noise, uv.shape)
        inside = (depth > 0) & (uv > 0).all(1) & (uv < [WIDTH, HEIGHT]).all(1)
        positions[inside, t] = uv[inside]
    return positions


def world(count: int, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform([-4, -2, 3], [5, 2, 12], (count, 3))


def state_of(cameras: list[Camera], points: np.ndarray) -> Reconstruction:
    viewmats = np.array([c.viewmat for c in cameras])
    return Reconstruction(viewmats[:, :3, :3], viewmats[:, :3, 3], cameras[0].K[0, 0], points)


def cameras_of(state: Reconstruction) -> list[Camera]:
    K = np.array([[state.focal, 0, WIDTH / 2], [0, state.focal, HEIGHT / 2], [0, 0, 1]])
    cameras = []
    for rotation, translation in zip(state.rotations, state.translations, strict=True):
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, translation
        cameras.append(Camera(viewmat, K, WIDTH, HEIGHT))
    return cameras


def centred(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    seen = np.isfinite(positions[..., 0])
    return np.where(seen[..., None], positions, 0) - [WIDTH / 2, HEIGHT / 2], seen


def test_bundle_adjustment_undoes_a_perturbation():
    cameras, points, rng = path(8), world(300), np.random.default_rng(3)
    positions, seen = centred(observed(cameras, points, 0.0))
    true = state_of(cameras, points)
    turned = Rotation.from_rotvec(rng.normal(0, 0.01, (8, 3))).as_matrix() @ true.rotations
    shifted = true.translations + rng.normal(0, 0.02, (8, 3))
    turned[0], shifted[0] = true.rotations[0], true.translations[0]
    start = Reconstruction(turned, shifted, 1.1 * FOCAL, points + rng.normal(0, 0.05, points.shape))
    observations = Observations.of(positions, seen)
    before, _ = residuals(start, observations)
    done = adjust(start, observations, iterations=50, scale=5.0, fixed_camera=0, tolerance=1e-12)
    after, depth = residuals(done.reconstruction, observations)
    assert np.median(before) > 3
    assert after.max() < 1e-3
    assert (depth > 0).all()
    assert done.reconstruction.focal == pytest.approx(FOCAL, rel=1e-4)
    assert done.focal_precision > 0
    np.testing.assert_array_equal(done.reconstruction.rotations[0], true.rotations[0])


def test_bundle_adjustment_holds_what_is_fixed():
    cameras, points = path(5), world(100)
    positions, seen = centred(observed(cameras, points, 0.3))
    start = state_of(cameras, points)
    done = adjust(
        start, Observations.of(positions, seen), iterations=5, scale=1.0, fixed_camera=2, free_focal=False,
        free_translations=False,
    )  # fmt: skip
    assert done.reconstruction.focal == FOCAL
    np.testing.assert_array_equal(done.reconstruction.translations, start.translations)
    np.testing.assert_allclose(done.reconstruction.rotations[2], start.rotations[2], atol=1e-14)


def test_triangulation_finds_points_and_far_ones_stay_in_front():
    cameras, points = path(6), world(50)
    positions, seen = centred(observed(cameras, points, 0.0))
    seen[0] = False
    often = seen.sum(1) >= 2
    state = state_of(cameras, points)
    np.testing.assert_allclose(triangulate(state, positions, seen)[often], points[often], atol=1e-6)
    far = np.concatenate([points, [[0.0, 0, 1e7], [1e6, 0, 2e7]]])
    positions, seen = centred(observed(cameras, far, 0.3))
    placed = place_points(state, positions, seen)
    _, depth = residuals(replace(state, points=placed), Observations.of(positions, seen))
    assert (depth > 0).all()
    assert np.isfinite(placed).all()


def test_rays_of_a_turning_camera_meet_on_the_sphere():
    cameras, points = path(6, travel=0.0), world(80)
    positions, seen = centred(observed(cameras, points, 0.0))
    often = seen.any(1)
    rays = ray_points(state_of(cameras, points), positions, seen)
    np.testing.assert_allclose(rays[often], (points / np.linalg.norm(points, axis=1, keepdims=True))[often], atol=1e-9)


def test_chosen_tracks_cover_the_picture_and_prefer_long_ones():
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, [WIDTH, HEIGHT], (3000, 1, 2)).repeat(10, 1)
    lengths = rng.integers(1, 11, 3000)
    seen = np.arange(10) < lengths[:, None]
    chosen = choose_tracks(positions, seen, WIDTH, HEIGHT, per_cell=4)
    assert lengths[chosen].min() >= 3
    assert lengths[chosen].mean() > 7
    cell = (positions[chosen, 0] / [WIDTH, HEIGHT] * GRID).astype(int)
    assert len(np.unique(cell, axis=0)) == GRID[0] * GRID[1]


@pytest.mark.parametrize("movers", [0, 120])
def test_a_moving_camera_is_recovered_although_some_points_move(movers):
    cameras, rng = path(24), np.random.default_rng(7)
    points = np.repeat(world(400)[None], 24, 0)
    start = rng.uniform([-2, -1, 3], [1, 1, 4], (movers, 3))
    times = np.linspace(0, 1, 24)[:, None, None]
    moving = start + times * np.array([1.5, 0.3, 0.5]) + 0.2 * np.sin(6 * times)
    positions = observed(cameras, np.concatenate([points, moving], 1), 0.1)
    found = estimate(positions, WIDTH, HEIGHT, None)
    assert found.motion == "free"
    assert found.unplaced == []
    assert find_breaks(positions, range(24)) == []
    errors = path_errors(cameras_of(found.fit.state), cameras)
    assert errors["path"] < 0.003
    assert errors["rotation"] < 0.05
    assert errors["focal"] < 0.01
    assert np.median(found.fit.errors) < 0.2
    again = estimate(positions, WIDTH, HEIGHT, None)
    np.testing.assert_array_equal(again.fit.state.translations, found.fit.state.translations)


def test_a_given_focal_length_is_kept():
    cameras = path(10)
    found = estimate(observed(cameras, world(300), 0.1), WIDTH, HEIGHT, FOCAL)
    assert found.fit.state.focal == FOCAL
    assert path_errors(cameras_of(found.fit.state), cameras)["path"] < 0.005


def test_a_turning_camera_is_recognised_with_its_focal_length():
    cameras = path(16, travel=0.0)
    found = estimate(observed(cameras, world(500), 0.08), WIDTH, HEIGHT, None)
    assert found.motion == "rotation"
    assert (found.fit.state.translations == 0).all()
    errors = path_errors(cameras_of(found.fit.state), cameras)
    assert errors["rotation"] < 0.1
    assert errors["focal"] < 0.02


def test_frames_that_nothing_joins_are_named():
    positions = observed(path(12), world(300), 0.1)
    cut = np.concatenate([positions, positions])
    cut[: len(positions), 6:] = np.nan
    cut[len(positions) :, :6] = np.nan
    assert find_breaks(cut, range(12)) == [6]


# -- the stage on pictures


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
    assert all(camera.is_finite for camera in scene.cameras)
    json.dumps(scene.prior("cameras"), allow_nan=False)


def test_blank_pictures_say_so(tmp_path):
    scene = scene_of(tmp_path / "scene", [np.full((48, 64, 3), 90, np.uint8)] * 3)
    camera_stage(scene, CameraOptions())
    assert scene.prior("cameras")["static"]
    assert "Nothing in the pictures could be followed" in scene.prior("cameras")["verdict"]


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
