"""Jumps of depth lie where the images have them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flowsplat.priors.background.depth_edge_refinement import EdgeView, refine_edges

from .planes import FOCAL, HEIGHT, SIDE, WALL, WIDTH, camera_at, texture

SHIFTS = (-12, -8, -4, 4, 8, 12)
LEFT, TOP = 50, 25


def still_square(shift: int) -> tuple[np.ndarray, np.ndarray]:
    """Image [H, W, 3] and inverse depth [H, W] of a square at half the wall's depth; the wall is ``shift`` pixels to the left."""
    wall = texture(0, WIDTH + 40, HEIGHT)
    image = wall[:, 20 + shift : 20 + shift + WIDTH].copy()
    inverse = np.full((HEIGHT, WIDTH), 1 / WALL, np.float32)
    x = LEFT - 2 * shift
    image[TOP : TOP + SIDE, x : x + SIDE] = texture(1, SIDE, SIDE)
    inverse[TOP : TOP + SIDE, x : x + SIDE] = 2 / WALL
    return image, inverse


def refined(inverse: np.ndarray, still: np.ndarray, moving: bool = False, doubted: np.ndarray | None = None) -> np.ndarray:
    views = seen({shift: still_square(shift)[0] for shift in (0, *SHIFTS)}, moving)
    return refine_edges(inverse, still, views[0], camera_at(0), views[1:], [camera_at(shift) for shift in SHIFTS], doubted)


def seen(images: dict[int, np.ndarray], moving: bool = False) -> list[EdgeView]:
    return [EdgeView.of(np.ascontiguousarray(each), np.full(each.shape[:2], moving)) for each in images.values()]


def test_a_view_has_the_colors_of_its_image():
    image = still_square(0)[0]
    view = seen({0: image})[0]
    np.testing.assert_array_equal(view.features[..., :3], image)
    np.testing.assert_array_equal(view.features[..., 3], view.slopes)
    assert view.slopes.max() > 10


def test_the_camera_is_that_of_the_images():
    # Half the depth, twice the shift.
    assert camera_at(8).viewmat[0, 3] * FOCAL * 2 / WALL == pytest.approx(-16)


@pytest.mark.parametrize("change", ["swollen", "shrunk"])
def test_swollen_and_shrunk_surfaces_end_where_their_image_ends(change):
    true = still_square(0)[1]
    operation = cv2.dilate if change == "swollen" else cv2.erode
    wrong = operation(true, np.ones((9, 9), np.uint8))
    before, everywhere = np.abs(wrong - true) > 0.01, np.ones(true.shape, bool)
    after = np.abs(refined(wrong, everywhere) - true) > 0.01
    assert before.sum() > 300
    assert after.sum() < 0.15 * before.sum()


def test_what_is_right_stays_and_what_moves_is_left_alone():
    true, everywhere = still_square(0)[1], np.ones((HEIGHT, WIDTH), bool)
    assert (np.abs(refined(true, everywhere) - true) > 0.01).mean() < 0.01
    wrong = cv2.dilate(true, np.ones((9, 9), np.uint8))
    np.testing.assert_array_equal(refined(wrong, ~everywhere), wrong)


def test_frames_that_show_only_what_moves_say_nothing():
    wrong, everywhere = cv2.dilate(still_square(0)[1], np.ones((9, 9), np.uint8)), np.ones((HEIGHT, WIDTH), bool)
    np.testing.assert_array_equal(refined(wrong, everywhere, moving=True), wrong)


def test_an_even_slope_has_no_jump():
    slope = np.tile(np.linspace(0.2, 0.21, WIDTH, dtype=np.float32), (HEIGHT, 1))
    np.testing.assert_array_equal(refined(slope, np.ones(slope.shape, bool)), slope)


def test_only_what_is_doubted_is_asked_about():
    true, everywhere = still_square(0)[1], np.ones((HEIGHT, WIDTH), bool)
    wrong = cv2.dilate(true, np.ones((9, 9), np.uint8))
    doubted = everywhere.copy()
    doubted[:, WIDTH // 2 :] = False
    result = refined(wrong, everywhere, doubted=doubted)
    np.testing.assert_array_equal(result[~doubted], wrong[~doubted])
    assert (result != wrong)[doubted].any()


def test_frames_whose_image_ends_before_the_place_do_not_count_against_it():
    # One camera of six still sees the left of the wall; were it farther off, all of them would.
    shifts = (-8, 40, 44, 48, 52, 56)
    wall = texture(0, WIDTH + 120, HEIGHT)
    views = seen({shift: wall[:, 20 + shift : 20 + shift + WIDTH] for shift in (0, *shifts)})
    true = np.full((HEIGHT, WIDTH), 1 / WALL, np.float32)
    wrong = true.copy()
    wrong[20:60, 24:36] *= 0.4
    cameras = [camera_at(shift) for shift in shifts]
    result = refine_edges(wrong, np.ones(true.shape, bool), views[0], camera_at(0), views[1:], cameras)
    assert (np.abs(result / true - 1) > 0.05).sum() < 0.1 * (wrong != true).sum()
