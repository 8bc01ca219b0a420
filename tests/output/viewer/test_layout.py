"""Images on canvases."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.output.viewer.layout import BAR_GRAY, Box, empty, fit_box, halves, place, wipe


@pytest.mark.parametrize(
    ("size", "box"), [((64, 32), Box(0, 25, 100, 50)), ((20, 40), Box(25, 0, 50, 100)), ((7, 7), Box(0, 0, 100, 100))]
)
def test_images_are_fitted_into_the_middle(size, box):
    assert fit_box(size, Box(0, 0, 100, 100)) == box


def test_halves_fill_the_canvas():
    left, right = halves((101, 50))
    assert (left.x, left.width + right.width, right.x + right.width) == (0, 101, 101)
    assert left.height == right.height == 50


def test_an_image_is_placed_and_the_rest_stays():
    canvas = empty((10, 6))
    place(canvas, np.full((4, 4, 3), 200, np.uint8), Box(2, 1, 3, 2))
    assert (canvas[1:3, 2:5] == 200).all()
    canvas[1:3, 2:5] = BAR_GRAY
    assert (canvas == BAR_GRAY).all()


@pytest.mark.parametrize(("share", "columns"), [(0.0, 0), (0.5, 10), (1.0, 20), (7.0, 20)])
def test_the_wipe_covers_its_share(share, columns):
    image, over = np.zeros((4, 20, 3), np.uint8), np.full((4, 20, 3), 100, np.uint8)
    result = wipe(image, over, share)
    assert (result[:, : max(columns - 1, 0)] == 100).all()
    assert (result[:, columns + 1 :] == 0).all()
    assert (image == 0).all()
    assert bool((result == 255).any()) == (0 < columns < 20)
