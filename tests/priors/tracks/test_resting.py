"""Points of the background get the path that cameras and depth give them, and those without one are given up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.priors.prepare import use_truth
from flowsplat.priors.tracks.resting import SUPPOSED_CONFIDENCE, complete_resting
from flowsplat.scenes import Scene

from ..planes import FRAMES, HEIGHT, SIDE, WIDTH, square_at, write_planes

STEP, BIRTH = 2, 4


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """A wall that moves by -2 pixels a frame, a square before it that moves by (3, 2), and everything known of them."""
    scene = write_planes(tmp_path_factory.mktemp("resting"), step=STEP, square=True)
    use_truth(scene)
    return scene


def on_the_wall(start: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Paths of points of the wall that are at ``start`` in frame ``BIRTH``, found in every frame that shows them, births."""
    steps = np.arange(FRAMES) - BIRTH
    points = np.array(start, np.float32)[:, None] + steps[:, None] * np.float32([-STEP, 0])
    inside = (points >= 0).all(-1) & (points < [WIDTH, HEIGHT]).all(-1)
    return points, np.where(inside, 0.9, 0).astype(np.float32), np.full(len(points), BIRTH)


def complete(scene: Scene, points: np.ndarray, confidence: np.ndarray, births: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    before = points.copy(), confidence.copy()
    result = complete_resting(scene, points, confidence, births)
    np.testing.assert_array_equal(points, before[0])  # what is given stays
    np.testing.assert_array_equal(confidence, before[1])
    return result


def test_gaps_and_slips_are_mended(scene: Scene):
    points, confidence, births = on_the_wall([(70.5, 10.5), (90.3, 70.2), (100.5, 12.5)])
    true = points.copy()
    confidence[0, 6:9] = 0
    points[0, 6:9] = 0
    points[1, 8:] += [4, 3]  # it slips
    found, sure = complete(scene, points, confidence, births)
    assert np.abs(found - true)[sure > 0].max() < 0.05
    assert (sure > 0).all()
    np.testing.assert_allclose(sure[0, 6:9], SUPPOSED_CONFIDENCE)
    np.testing.assert_allclose(sure[1, 8:], SUPPOSED_CONFIDENCE)
    np.testing.assert_array_equal(sure[2], confidence[2])


def test_behind_an_object_and_outside_nothing_is_seen(scene: Scene):
    x, y = square_at(8)
    points, confidence, births = on_the_wall([(x + SIDE / 2 + 4 * STEP, y + SIDE / 2), (5.5, 70.5), (100.5, 70.5)])
    hidden = scene.truth.mask(8)[y + SIDE // 2, x + SIDE // 2]
    assert hidden
    confidence[0, 8] = 0
    confidence[1, 7:] = 0
    _, sure = complete(scene, points, confidence, births)
    assert sure[0, 8] == 0
    assert sure[1, 6] > 0
    assert (sure[1, 7:] == 0).all()  # it has left the image


def test_what_does_not_rest_is_given_up_and_objects_are_left_alone(scene: Scene):
    points, confidence, _ = on_the_wall([(100.5, 12.5), (90.5, 70.5), (110.5, 60.5), (80.5, 72.5)])
    points[3] = (80.5, 72.5) + (np.arange(FRAMES) - BIRTH)[:, None] * np.float32([0, 0.6])
    x, y = square_at(BIRTH)
    obj = np.array([x + 9.5, y + 9.5]) + (np.arange(FRAMES) - BIRTH)[:, None] * np.float32([3, 2])
    points, confidence = np.concatenate([points, obj[None]]), np.concatenate([confidence, confidence[:1]])
    found, sure = complete(scene, points.astype(np.float32), confidence, np.full(5, BIRTH))
    assert np.flatnonzero(sure[3]).tolist() == [BIRTH]
    np.testing.assert_array_equal(found[4], points[4].astype(np.float32))
    np.testing.assert_array_equal(sure[4], confidence[4])


def test_where_hardly_anything_rests_cameras_are_not_believed(scene: Scene):
    points, confidence, births = on_the_wall([(100.5, 12.5), (90.5, 70.5), (80.5, 72.5)])
    points[1:] = points[1:, BIRTH, None] + (np.arange(FRAMES) - BIRTH)[:, None] * np.float32([0, 0.7])
    confidence[0, 6] = 0
    found, sure = complete(scene, points, confidence, births)
    np.testing.assert_array_equal(found, points)
    np.testing.assert_array_equal(sure, confidence)


def test_without_masks_or_points_all_stays(scene: Scene, tmp_path: Path):
    points, confidence, births = on_the_wall([(100.5, 12.5)])
    confidence[0, 6] = 0
    bare = write_planes(tmp_path, step=STEP, square=False)
    assert complete(bare, points, confidence, births)[1][0, 6] == 0
    assert complete(scene, points[:0], confidence[:0], births[:0])[0].shape == (0, FRAMES, 2)
