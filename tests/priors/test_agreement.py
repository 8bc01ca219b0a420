"""What frames agree on: a wall, and before it a square whose depth some frames have too large or too small."""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.priors.background.depth_voting import SAME, vote_on_depth

from .planes import HEIGHT, SIDE, WALL, WIDTH, camera_at

SHIFTS = (-12, -8, -4, 4, 8, 12)
LEFT, TOP = 50, 25
EVERYWHERE = np.ones((HEIGHT, WIDTH), bool)


def true_inverse(shift: int) -> np.ndarray:
    """[H, W] of a square at half the wall's depth, from a camera that sees the wall ``shift`` pixels farther to the left."""
    inverse = np.full((HEIGHT, WIDTH), 1 / WALL, np.float32)
    x = LEFT - 2 * shift
    inverse[TOP : TOP + SIDE, x : x + SIDE] = 2 / WALL
    return inverse


def swollen(inverse: np.ndarray, pixels: int) -> np.ndarray:
    return cv2.dilate(inverse, np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8))


def others(change=lambda inverse: inverse, there=EVERYWHERE) -> list:
    return [(change(true_inverse(shift)), there, camera_at(shift)) for shift in SHIFTS]


def test_one_frame_gives_way_to_many():
    wrong = swollen(true_inverse(0), 4)
    inverse, share = vote_on_depth(wrong, EVERYWHERE, camera_at(0), others())
    changed = wrong != true_inverse(0)
    # What lies behind the square is seen by the frames of one side only.
    assert np.abs(inverse - true_inverse(0))[changed].max() < 1e-4
    assert (share[changed] < 1).all(), "the frame itself did not agree"
    assert (share[:, : LEFT // 2] == 1).all()


def test_a_vote_is_on_one_of_the_surfaces_and_not_between_them():
    rng = np.random.default_rng(0)
    for _ in range(5):
        noise = [1 + rng.normal(0, 0.003, (HEIGHT, WIDTH)).astype(np.float32) for _ in SHIFTS]
        around = [
            (swollen(true_inverse(shift), rng.integers(0, 6)) * scale, EVERYWHERE, camera_at(shift))
            for shift, scale in zip(SHIFTS, noise, strict=True)
        ]
        inverse, share = vote_on_depth(swollen(true_inverse(0), 3), EVERYWHERE, camera_at(0), around)
        off = np.minimum(np.abs(inverse * WALL - 1), np.abs(inverse * WALL / 2 - 1))
        assert off.max() < SAME
        assert ((share > 0) & (share <= 1)).all()


def test_of_two_surfaces_with_as_many_votes_the_farther_is_taken():
    nearer = [(swollen(each, 4), there, camera) for each, there, camera in others()]
    inverse, _ = vote_on_depth(swollen(true_inverse(0), 4), EVERYWHERE, camera_at(0), [*others(), *nearer])
    beside = (swollen(true_inverse(0), 4) != true_inverse(0)) & (np.arange(HEIGHT)[:, None] < TOP)
    assert np.median(inverse[beside]) * WALL < 1 + SAME


def test_what_moves_is_left_alone_and_speaks_for_nothing():
    wrong = swollen(true_inverse(0), 4)
    inverse, share = vote_on_depth(wrong, EVERYWHERE, camera_at(0), others(there=~EVERYWHERE))
    np.testing.assert_array_equal(inverse, wrong)
    assert (share == 1).all(), "nobody was asked"
    inverse, share = vote_on_depth(wrong, ~EVERYWHERE, camera_at(0), others())
    np.testing.assert_array_equal(inverse, wrong)
    assert (share == 1).all()
