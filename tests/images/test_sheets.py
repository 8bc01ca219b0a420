"""Sheets of images."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.images.sheets import GAP_PIXELS, preview_sheet, side_by_side, stack, with_rulers


def test_side_by_side_keeps_images_and_resizes_to_the_first():
    a = np.full((40, 60, 3), 200, np.uint8)
    b = np.full((20, 10, 3), 0.2, np.float32)
    gray = np.full((40, 30), 90, np.uint8)
    sheet = side_by_side([a, b, gray])
    assert sheet.shape == (40, 60 + 20 + 30 + 2 * GAP_PIXELS, 3)
    assert sheet.dtype == np.uint8
    assert (sheet[:, :60] == 200).all()
    assert (sheet[:, 60 : 60 + GAP_PIXELS] == 255).all()
    assert (sheet[:, 60 + GAP_PIXELS : 80 + GAP_PIXELS] == 51).all()
    assert (sheet[:, -30:] == 90).all()


def test_labels_are_written_on_a_copy():
    a = np.full((80, 120, 3), 120, np.uint8)
    sheet = side_by_side([a, a], ["left", "right"])
    assert (a == 120).all()
    assert (sheet[:20, :40] != 120).any()
    assert (sheet[:20, 120 + GAP_PIXELS : 160 + GAP_PIXELS] != 120).any()
    assert (sheet[40:, :120] == 120).all()
    with pytest.raises(ValueError):
        side_by_side([a, a], ["only one"])


def test_height_and_stacked():
    a = np.zeros((40, 80, 3), np.uint8)
    assert side_by_side([a], height=20).shape == (20, 40, 3)
    assert stack([a, np.zeros((10, 40, 3), np.uint8)]).shape == (40 + GAP_PIXELS + 20, 80, 3)


def test_preview_sheet():
    image = np.random.default_rng(0).random((30, 40, 3)).astype(np.float32)
    assert preview_sheet(image, image).shape == (30, 3 * 40 + 2 * GAP_PIXELS, 3)
    assert preview_sheet((image * 255).astype(np.uint8), image).shape == (30, 3 * 40 + 2 * GAP_PIXELS, 3)


def test_rulers_name_places_in_pixels():
    image = np.full((90, 160, 3), 128, np.uint8)
    sheet = with_rulers(image, (854, 480))
    margin = sheet.shape[0] - 90
    assert sheet.shape == (90 + margin, 160 + margin, 3)
    assert (sheet[margin:, margin:] == 128).all(), "the image stays as it is"
    long_ticks = np.flatnonzero((sheet[margin - 8, margin:] == 90).all(-1))
    np.testing.assert_allclose(long_ticks * 854 / 160, np.arange(0, 854, 500), atol=3)
    ticks = np.flatnonzero((sheet[margin - 2, margin:] == 90).all(-1))
    np.testing.assert_allclose(ticks * 854 / 160, np.arange(0, 854, 100), atol=3)
    down = np.flatnonzero((sheet[margin:, margin - 2] == 90).all(-1))
    np.testing.assert_allclose(down * 480 / 90, np.arange(0, 480, 100), atol=3)


@pytest.mark.parametrize("width", [801, 1081, 1281, 1921])
def test_the_last_tick_of_a_ruler_is_on_the_sheet(width):
    """``round`` can put the tick of the last pixels onto the sheet's own end."""
    image = np.full((225, 400, 3), 128, np.uint8)
    for size, shown in (((width, 600), image), ((600, width), image.transpose(1, 0, 2))):
        sheet = with_rulers(shown, size)
        margin = sheet.shape[0] - shown.shape[0]
        assert (sheet[margin:, margin:] == 128).all()
