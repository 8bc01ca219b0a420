from __future__ import annotations

import cv2
import numpy as np
import pytest

from flowsplat.priors.flow import flow_stage
from flowsplat.priors.tracks import TrackTable, corner_strength, new_points, oldest_of_crowds, refine_points, tracks_stage
from flowsplat.scenes import Scene


def texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def shifted(image: np.ndarray, x: float, y: float, width: int, height: int) -> np.ndarray:
    """The window at (20 - x, 20 - y): its content moves by (x, y)."""
    matrix = np.array([[1, 0, x - 20], [0, 1, y - 20]], np.float32)
    return cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_CUBIC)


def test_refinement_reaches_a_small_fraction_of_a_pixel():
    big = texture(160, 200)
    a, b = shifted(big, 0, 0, 150, 110), shifted(big, 1.37, -0.62, 150, 110)
    points = new_points(corner_strength(a), np.zeros((0, 2)), 12)
    points = points[(points > 12).all(1) & (points < [138, 98]).all(1)]
    found, ok = refine_points(a, b, points, points + [1.0, 0.0], 15)
    assert ok.mean() > 0.9
    assert np.median(np.linalg.norm(found - points - [1.37, -0.62], axis=1)[ok]) < 0.05


def test_refinement_refuses_what_is_not_there():
    points = np.random.default_rng(0).uniform(20, 80, (50, 2))
    _, ok = refine_points(texture(100, 100, 1), texture(100, 100, 2), points, points, 15)
    assert ok.mean() < 0.4
    assert refine_points(texture(100, 100), texture(100, 100), np.zeros((0, 2)), np.zeros((0, 2)), 15)[0].shape == (0, 2)


def test_new_points_fill_only_empty_cells_of_any_picture_size():
    strength = np.ones((25, 37), np.float32)
    everything = new_points(strength, np.zeros((0, 2)), 10)
    assert len(everything) == 4 * 3
    assert len(new_points(strength, everything, 10)) == 0
    assert len(new_points(np.zeros_like(strength), np.zeros((0, 2)), 10)) == 0


def test_the_oldest_of_a_crowd_stays():
    points = np.array([[1.0, 1], [2, 2], [15, 1], [3, 3], [16, 2]])
    assert oldest_of_crowds(points, 10).tolist() == [0, 2]


def test_a_table_keeps_what_was_noted():
    table = TrackTable()
    a, b = table.start(2), table.start(1)
    table.add(0, a, np.array([[1.0, 2], [3, 4]]))
    table.add(2, np.concatenate([a[1:], b]), np.array([[5.0, 6], [7, 8]]))
    values = table.values(3)
    assert values.shape == (3, 3, 2)
    assert values[1, 2].tolist() == [5, 6]
    assert np.isfinite(values[..., 0]).tolist() == [[True, False, False], [True, False, True], [False, False, True]]


@pytest.fixture
def scene(tmp_path) -> Scene:
    """A background that moves by (1.5, 0.5) and a square on it that moves by (-2, 1) pixels a frame; frame 3 held out."""
    back, front = texture(120, 160), texture(40, 40, seed=5)
    scene = Scene.create(
        tmp_path / "scene", name="s", source="", width=112, height=80, timestamps=range(8), holdout=4, source_fps=1
    )
    for i in range(8):
        image = shifted(back, 1.5 * i, 0.5 * i, 112, 80)
        x, y = 66 - 2 * i, 16 + i
        image[y : y + 36, x : x + 36] = front[:36, :36]
        scene.write_frame(i, np.repeat(image[..., None], 3, 2))
        if i in scene.train_frames:
            mask = np.zeros((80, 112), np.uint8)
            mask[y : y + 36, x : x + 36] = 1
            scene.write_mask(i, mask)
    return scene


def test_tracks_follow_both_motions_and_leave_held_out_frames_alone(scene):
    scene.finish_prior("masks", method="given")
    flow_stage(scene)
    tracks_stage(scene)
    tracks = scene.tracks
    assert scene.heldout_frames == [3]
    assert not tracks.visible[:, 3].any()
    assert np.isfinite(tracks.points).all()
    assert tracks.moving.sum() > 50
    assert (~tracks.moving).sum() > 50
    frames = np.array(scene.train_frames)
    for moving, velocity in ((True, (-2, 1)), (False, (1.5, 0.5))):
        chosen = np.flatnonzero((tracks.moving == moving) & tracks.visible[:, frames].all(1))
        assert len(chosen) > 10
        travelled = tracks.points[chosen, 7] - tracks.points[chosen, 0]
        assert np.median(np.linalg.norm(travelled - 7 * np.array(velocity), axis=1)) < 0.3
    assert scene.prior("tracks")["moving"] == tracks.moving.sum()


def test_without_masks_nothing_is_called_moving(scene):
    flow_stage(scene)
    tracks_stage(scene)
    assert len(scene.tracks.points) > 100
    assert not scene.tracks.moving.any()
