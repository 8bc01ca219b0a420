"""Clips that break things: every one ends with a usable scene and a verdict that is true."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from flowsplat.gaussians.initialize import initialize
from flowsplat.gaussians.observations import load_observations
from flowsplat.geometry import Camera
from flowsplat.geometry.similarity import path_errors
from flowsplat.images.blank import is_blank
from flowsplat.priors.cameras.bundle import Reconstruction
from flowsplat.priors.cameras.keyframes import MAX_JOINT_FRAMES, choose_keyframes, place_between
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.pieces import PIECE_DISTANCE, find_breaks, join, split
from flowsplat.priors.continuity import Continuity
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes import Scene
from flowsplat.training.config import PRESETS
from tests.marks import slow

WIDTH, HEIGHT = 128, 80
WALL = (-14.0, -9.0, 14.0, 9.0, 8.0)
ROOM = [WALL, (-9.0, -1.0, -3.0, 4.0, 6.0), (1.5, -2.0, 3.5, 3.0, 5.0), (-2.0, 0.8, 0.2, 3.0, 4.0)]
Rectangle = tuple[float, float, float, float, float]
"""Left, top, right, bottom and depth of an upright textured rectangle, in meters."""


def texture(height: int, width: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width, 3), np.float32)
    for sigma, strength in ((1.2, 1.0), (3.0, 1.5), (8.0, 2.5)):
        smooth = cv2.GaussianBlur(rng.normal(size=(height, width, 3)).astype(np.float32), (0, 0), sigma)
        image += strength * smooth / smooth.std()
    return np.clip(image / image.std() * 40 + rng.uniform(80, 170, 3), 0, 255).astype(np.uint8)


class World:
    """Textured rectangles, the far ones first, for images of about that width."""

    def __init__(self, rectangles: Sequence[Rectangle], seed: int = 0, width: int = WIDTH):
        self._parts = []
        for k, (x0, y0, x1, y1, z) in enumerate(rectangles):
            density = 1.2 * width / z
            self._parts.append(((x0, y0, x1, y1, z), texture(int((y1 - y0) * density), int((x1 - x0) * density), 100 * seed + k)))

    def image(self, camera: Camera, shift: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
        """RGB with a little noise; ``shift`` moves the last rectangle."""
        image = np.zeros((camera.height, camera.width, 3), np.uint8)
        half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
        for k, ((x0, y0, x1, y1, z), colors) in enumerate(self._parts):
            dx, dy, dz = shift if k == len(self._parts) - 1 else (0, 0, 0)
            h, w = colors.shape[:2]
            to_world = np.array([[(x1 - x0) / w, 0, x0 + dx], [0, (y1 - y0) / h, y0 + dy], [0, 0, z + dz], [0, 0, 1]])
            H = np.linalg.inv(half) @ camera.K @ camera.viewmat[:3] @ to_world @ half
            size = (camera.width, camera.height)
            there = cv2.warpPerspective(np.ones((h, w), np.uint8), H, size, flags=cv2.INTER_NEAREST) > 0
            image[there] = cv2.warpPerspective(colors, H, size)[there]
        noise = np.random.default_rng(int(image.sum()) % 2**31).normal(0, 1.5, image.shape)
        return np.clip(image + noise, 0, 255).astype(np.uint8)


def camera_at(
    center: Sequence[float] = (0, 0, 0), turn: Sequence[float] = (0, 0, 0), size: tuple[int, int] = (WIDTH, HEIGHT)
) -> Camera:
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    focal = 0.9 * max(size)
    return Camera(viewmat, np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]]), *size)


def travel(count: int, way: float = 1.0, turn: float = 0.1, size: tuple[int, int] = (WIDTH, HEIGHT)) -> list[Camera]:
    return [
        camera_at((way * s, 0.1 * way * np.sin(3 * s), 0.2 * way * s * s), (0.02 * np.sin(4 * s), -turn * s, 0), size)
        for s in np.linspace(0, 1, count)
    ]


def write(folder: Path, frames: Sequence[np.ndarray]) -> Scene:
    height, width = frames[0].shape[:2]
    scene = Scene.create(
        folder, name="clip", source="", width=width, height=height, timestamps=[i / 24 for i in range(len(frames))],
        holdout=10, source_fps=24.0,
    )  # fmt: skip
    for i, frame in enumerate(frames):
        scene.write_frame(i, frame)
    return scene


def prepared(folder: Path, frames: Sequence[np.ndarray]) -> Scene:
    """The scene with all of its priors, which are finite and enough to begin training with."""
    scene = write(folder, frames)
    prepare_priors(scene, PriorsOptions())
    scene = Scene(folder)
    json.dumps(scene.info.to_json(), allow_nan=False)
    assert all(camera.is_valid for camera in scene.cameras)
    for i in scene.train_frames:
        assert np.isfinite(scene.depth(i).depth).all()
        assert scene.mask(i).shape == (scene.height, scene.width)
    for i, j in scene.flow_pairs:
        assert np.isfinite(scene.flow(i, j).flow).all()
    assert np.isfinite(scene.tracks.points).all()
    assert all(scene.prior(name)["verdict"] for name in ("cameras", "masks", "depth", "tracks"))
    config = replace(PRESETS["default"].init, background_spacing=4.0, foreground_spacing=4.0)
    start = initialize(load_observations(scene), scene.tracks, PRESETS["default"].model, config, 0, 5000)
    assert len(start) > 50
    assert all(torch.isfinite(values).all() for values in start.params.values())
    return scene


@pytest.fixture(scope="module")
def room() -> World:
    return World(ROOM)


def test_a_static_camera_with_an_object(tmp_path):
    world, camera = World([*ROOM, (-0.9, -0.9, 0.2, 0.2, 3.2)]), camera_at()
    scene = prepared(tmp_path / "s", [world.image(camera, (0.06 * i, 0.04 * i, 0)) for i in range(10)])
    cameras = scene.prior("cameras")
    assert cameras["static"]
    assert "stands still" in cameras["verdict"]
    assert all((camera.viewmat == np.eye(4)).all() for camera in scene.cameras)
    assert scene.prior("depth")["method"] == "guess"
    assert "guess" in scene.prior("depth")["verdict"]
    assert "1 moving object on" in scene.prior("masks")["verdict"]


@pytest.mark.slow
def test_an_object_on_70_percent_of_the_image(tmp_path):
    world, camera = World([*ROOM, (-1.4, -0.78, 1.4, 0.78, 3.0)], width=320), camera_at(size=(320, 180))
    shifts = [(0.05 * np.sin(0.9 * i), 0.03 * np.cos(0.7 * i), 0.05 * np.sin(0.5 * i)) for i in range(8)]
    scene = prepared(tmp_path / "s", [world.image(camera, shift) for shift in shifts])
    assert scene.prior("cameras")["static"]
    assert "moves fills most of the image" in scene.prior("cameras")["verdict"]
    assert 0.5 < scene.prior("masks")["share"] < 0.85


@pytest.mark.parametrize("count", [8, slow(10)])
def test_a_moving_camera_behind_a_large_object_follows_the_rim(tmp_path, count):
    cameras = travel(count, 0.6, size=(320, 180))
    world = World([*ROOM, (-1.4, -0.78, 1.4, 0.78, 3.0)], width=320)
    frames = [
        world.image(c, (c.center[0] + 0.05 * np.sin(0.9 * i), c.center[1] + 0.04 * np.cos(1.7 * i), 0.15 * np.sin(0.8 * i)))
        for i, c in enumerate(cameras)
    ]
    scene = prepared(tmp_path / "s", frames)
    assert "moves fills most of the image" in scene.prior("cameras")["verdict"]
    assert path_errors(scene.cameras, cameras)["rotation"] < 1.5


def test_pure_rotation(tmp_path, room):
    turns = [(0.03 * np.sin(4 * s), -0.25 * s, 0.02 * s) for s in np.linspace(0, 1, 10)]
    cameras = [camera_at(turn=turn) for turn in turns]
    scene = prepared(tmp_path / "s", [room.image(camera) for camera in cameras])
    assert scene.prior("cameras")["motion"] == "rotation"
    assert "only turns" in scene.prior("cameras")["verdict"]
    assert path_errors(scene.cameras, cameras)["rotation"] < 0.1
    assert np.ptp([camera.center for camera in scene.cameras], axis=0).max() < 1e-9
    assert scene.prior("depth")["method"] == "guess"


def test_a_plane_is_named(tmp_path):
    world = World([(-20, -12, 20, 12, 5)])
    scene = prepared(tmp_path / "s", [world.image(camera) for camera in travel(8)])
    assert "One plane explains" in scene.prior("cameras")["verdict"]
    assert "focal length is a guess" in scene.prior("cameras")["verdict"]


def test_little_parallax_still_gives_better_depth_than_a_guess(tmp_path):
    cameras = travel(10, 0.3, turn=0.2)
    scene = prepared(tmp_path / "s", [World(ROOM).image(camera) for camera in cameras])
    assert scene.prior("depth")["method"] == "multi-view"
    depth = scene.depth(0).depth
    wall, pillar = np.median(depth[30:60, 55:75]), np.median(depth[30:60, 103:122])
    assert pillar / wall == pytest.approx(5 / 8, rel=0.15)


def test_a_cut(tmp_path, room):
    half = travel(6, 0.6)
    other = World([(-14, -9, 14, 9, 7), (-4, -2, -1, 3, 5), (0, -3, 3, 1, 4)], seed=5)
    scene = prepared(tmp_path / "s", [room.image(c) for c in half] + [other.image(c) for c in half])
    cameras = scene.prior("cameras")
    assert cameras["breaks"] == [6]
    assert "cut before frame 6 (0.25 s)" in cameras["verdict"]
    assert "--start and --end" in cameras["verdict"]
    for piece in (scene.cameras[:6], scene.cameras[6:]):
        errors = path_errors(piece, half)
        assert errors["path"] < 0.05
        assert errors["rotation"] < 0.5
    # The pieces are worlds apart: what one of them shows is in no image of the other.
    assert scene.cameras[6].center[0] - scene.cameras[5].center[0] > 0.9 * PIECE_DISTANCE
    points = scene.cameras[6].unproject(np.array([[1.0, 1], [127, 79]]), np.full(2, 20.0))
    pixels, _ = scene.cameras[0].project(points)
    assert (pixels[:, 0] > WIDTH).all()
    assert scene.flow(5, 6).trusted.mean() < 0.4
    assert not (scene.tracks.visible[:, 5] & scene.tracks.visible[:, 6]).any()
    assert np.mean([scene.depth(i).trusted.mean() for i in scene.train_frames]) > 0.7


def test_black_frames_in_the_middle(tmp_path, room):
    cameras = travel(11)
    frames = [room.image(camera) for camera in cameras]
    frames[4] = frames[5] = np.zeros_like(frames[0])
    scene = prepared(tmp_path / "s", frames)
    assert scene.prior("cameras")["blank"] == [4, 5]
    assert scene.prior("cameras")["breaks"] == []
    assert "Frames 4 and 5 are blank" in scene.prior("cameras")["verdict"]
    assert path_errors(scene.cameras, cameras)["path"] < 0.05
    assert not scene.tracks.visible[:, [4, 5]].any()


@pytest.mark.parametrize("level", [0, 255])
def test_nothing_but_blank_frames(tmp_path, level):
    scene = prepared(tmp_path / "s", [np.full((HEIGHT, WIDTH, 3), level, np.uint8)] * 5)
    assert scene.prior("cameras")["motion"] == "unknown"
    assert "could be followed" in scene.prior("cameras")["verdict"]
    assert "All frames are blank" in scene.prior("cameras")["verdict"]


def test_nothing_but_noise(tmp_path):
    rng = np.random.default_rng(0)
    scene = prepared(tmp_path / "s", [rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(8)])
    assert scene.prior("cameras")["motion"] == "unknown"
    assert "Nothing in the images could be followed" in scene.prior("cameras")["verdict"]


def test_duplicate_frames(tmp_path, room):
    cameras = [camera for camera in travel(6) for _ in range(2)]
    images = [room.image(camera) for camera in cameras]
    scene = prepared(tmp_path / "s", [images[i // 2 * 2] for i in range(12)])
    assert scene.prior("cameras")["motion"] == "free"
    assert path_errors(scene.cameras, cameras)["path"] < 0.05
    still = prepared(tmp_path / "t", [images[0]] * 4)
    assert still.prior("cameras")["static"]


@pytest.mark.parametrize("count", [2, 3])
def test_a_few_frames(tmp_path, room, count):
    scene = prepared(tmp_path / "s", [room.image(camera) for camera in travel(count, 0.2)])
    assert scene.prior("cameras")["motion"] == "free"
    assert len(scene.cameras) == count


def test_portrait(tmp_path, room):
    cameras = travel(8, size=(HEIGHT, WIDTH))
    scene = prepared(tmp_path / "s", [room.image(camera) for camera in cameras])
    assert path_errors(scene.cameras, cameras)["path"] < 0.03
    assert "field of view" in scene.prior("cameras")["verdict"]


@pytest.mark.slow
def test_hundreds_of_small_frames(tmp_path, room):
    """More than are solved for at once (``MAX_JOINT_FRAMES``): most are placed between keyframes."""
    cameras = [
        camera_at(
            (0.8 * np.sin(12 * s), 0.2 * np.sin(18 * s), 0.3 * np.sin(6 * s)),
            (0.02 * np.sin(30 * s), 0.1 * np.sin(20 * s), 0), (64, 48),
        )
        for s in np.linspace(0, 1, 2 * MAX_JOINT_FRAMES)
    ]  # fmt: skip
    scene = prepared(tmp_path / "s", [room.image(camera) for camera in cameras])
    assert scene.prior("cameras")["breaks"] == []
    assert scene.prior("cameras")["unplaced"] == []
    errors = path_errors(scene.cameras, cameras)
    assert errors["path"] < 0.02
    assert errors["rotation"] < 1.0


# -- the parts


def tracks_of(cameras: Sequence[Camera], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions [N, T, 2] from the middle of the image and which of them are seen [N, T]."""
    uv, depth = zip(*(camera.project(points) for camera in cameras), strict=True)
    positions = np.stack(uv, 1)
    seen = (np.stack(depth, 1) > 0) & (positions > 0).all(-1) & (positions < [WIDTH, HEIGHT]).all(-1)
    return np.where(seen[..., None], positions - [WIDTH / 2, HEIGHT / 2], 0), seen


def test_frames_between_keyframes_are_placed_exactly():
    cameras = travel(61, 2.0, turn=0.3)
    points = np.random.default_rng(0).uniform([-3, -2, 3], [4, 2, 9], (300, 3))
    positions, seen = tracks_of(cameras, points)
    keys = np.arange(0, 61, 6)
    viewmats = np.array([camera.viewmat for camera in cameras])
    state = Reconstruction(viewmats[keys, :3, :3], viewmats[keys, :3, 3], cameras[0].K[0, 0], np.zeros((300, 3)))
    found, lost = place_between(keys, state, Observations.of(positions, seen), free_translations=True)
    assert lost == []
    np.testing.assert_allclose(found.rotations, viewmats[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(found.translations, viewmats[:, :3, 3], atol=1e-5)
    hidden = seen.copy()
    hidden[:, 3] = False
    assert place_between(keys, state, Observations.of(positions, hidden), free_translations=True)[1] == [3]


def test_keyframes_are_closer_where_tracks_are_short():
    assert choose_keyframes(Observations.of(np.zeros((20, 100, 2)))).tolist() == list(range(100))
    start = np.arange(-20, 200)
    frame = np.arange(200)
    life = np.where(start < 100, 40, 8)
    seen = (frame >= start[:, None]) & (frame < (start + life)[:, None])
    keys = choose_keyframes(Observations.of(np.zeros((*seen.shape, 2)), seen))
    assert (keys[0], keys[-1]) == (0, 199)
    gaps = np.diff(keys)
    assert gaps[keys[1:] < 90].mean() > 2 * gaps[(keys[:-1] > 110) & (keys[1:] < 199)].mean()


def test_breaks_split_and_pieces_are_joined_side_by_side():
    rng = np.random.default_rng(0)
    steps = np.arange(8)[None, :, None] * np.array([2.0, 1.0])
    positions = (rng.uniform(0, 100, (100, 1, 2)) + steps).repeat(2, 0)
    positions[:100, 4:] = np.nan
    positions[100:, :4] = np.nan
    shown = [0, 1, 2, 4, 5, 6, 7]
    assert find_breaks(Observations.of(positions), shown) == [4]
    assert find_breaks(Observations.of(positions[:100, :4]), range(4)) == []
    assert split(shown, [4]) == [[0, 1, 2], [4, 5, 6, 7]]
    assert split(range(6), range(1, 6)) == []
    still = [camera_at()] * 4
    cameras = join([[0, 1, 2], [4, 5, 6, 7]], [still[:3], still], 9)
    assert [round(camera.center[0]) for camera in cameras] == [0, 0, 0, 0] + [round(PIECE_DISTANCE)] * 5


def test_survivors_that_move_every_way_are_no_survivors():
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, 400, (200, 2, 2))
    positions[30:, 1] = np.nan
    assert find_breaks(Observations.of(positions), [0, 1]) == [1]
    positions[:30, 1] = positions[:30, 0] + [5, 2]
    assert find_breaks(Observations.of(positions), [0, 1]) == []


@pytest.mark.parametrize(("make", "blank"), [(np.zeros_like, True), (lambda a: a // 100, True), (lambda a: a, False)])
def test_blank_images(make: Callable[[np.ndarray], np.ndarray], blank: bool):
    assert is_blank(make(texture(40, 60, 1)[..., 0])) == blank


def test_matches_need_the_same_piece_and_something_to_see(tmp_path):
    image = texture(48, 64, 1)
    frames = [image] * 6
    frames[1] = np.zeros_like(image)
    scene = write(tmp_path / "s", frames)
    scene.finish_prior("cameras", method="tracks", breaks=[4])
    continuity = Continuity(scene)
    assert continuity.are_joined(0, 2)
    assert not continuity.are_joined(0, 1)
    assert not continuity.are_joined(2, 4)
    assert continuity.same_piece(0, 1)
