"""A tracker that loses an object for some frames: it gets its masks there, and what is hidden gets none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flowsplat.priors.given.mask_gaps import MAX_GAP, fill_gaps

SIZE = (128, 192)
FRAMES = 16


def texture(seed: int, height: int, width: int) -> np.ndarray:
    """Noise that flow can follow."""
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return np.clip(128 + 5 * (smooth - 128), 0, 255).astype(np.uint8)


class Drawn:
    """Frames in which a square slides over the ground, behind a bar where there is one."""

    def __init__(self, bar: bool = False):
        self.ground, self.square, self.front = texture(0, *SIZE), texture(1, 40, 40), texture(2, SIZE[0], 60)
        self.bar = bar

    def mask(self, i: int) -> np.ndarray:
        mask = np.zeros(SIZE, np.uint8)
        mask[40:80, 10 + 8 * i : 50 + 8 * i] = 3
        if self.bar:
            mask[:, 70:130] = 0
        return mask

    def frame(self, i: int) -> np.ndarray:
        image = self.ground.copy()
        image[40:80, 10 + 8 * i : 50 + 8 * i] = self.square
        if self.bar:
            image[:, 70:130] = self.front
        return image


def iou(a, b):
    return (a & b).sum() / max((a | b).sum(), 1)


@pytest.mark.parametrize("lost", [range(5, 6), range(4, 12)])
def test_what_was_lost_for_some_frames_is_found_there(lost):
    clip = Drawn()
    masks = {i: np.zeros(SIZE, np.uint8) if i in lost else clip.mask(i) for i in range(FRAMES)}
    found, filled = fill_gaps(masks, clip)
    assert filled == {3: list(lost)}
    for i in range(FRAMES):
        assert iou(found[i] == 3, clip.mask(i) == 3) > 0.7
        if i not in lost:
            assert np.array_equal(found[i], clip.mask(i))


def test_what_is_hidden_stays_without_a_mask():
    clip = Drawn(bar=True)
    masks = {i: clip.mask(i) for i in range(FRAMES)}
    gone = [i for i in masks if not masks[i].any()]
    assert 3 <= len(gone) <= MAX_GAP
    found, filled = fill_gaps(masks, clip)
    assert filled == {}
    assert all(np.array_equal(found[i], masks[i]) for i in masks)


def test_what_comes_late_ends_early_or_is_gone_for_long_is_left_alone():
    clip = Drawn()
    for absent in (range(5), range(10, FRAMES), range(1, MAX_GAP + 2)):
        masks = {i: np.zeros(SIZE, np.uint8) if i in absent else clip.mask(i) for i in range(FRAMES)}
        assert fill_gaps(masks, clip)[1] == {}


def test_other_objects_keep_their_pixels():
    clip = Drawn()
    masks = {i: clip.mask(i) for i in range(FRAMES)}
    masks[8] = np.zeros(SIZE, np.uint8)
    masks[8][40:80, 80:90] = 7
    found, filled = fill_gaps(masks, clip)
    assert filled == {3: [8]}
    assert (found[8][40:80, 80:90] == 7).all()
