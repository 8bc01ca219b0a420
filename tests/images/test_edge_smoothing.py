"""Smoothing along the edges of an image."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from flowsplat.images.edge_smoothing import EdgeSmoother


@pytest.fixture
def threads() -> Iterator[None]:
    before = cv2.getNumThreads()
    yield
    cv2.setNumThreads(before)


def test_any_number_of_threads_gives_the_same_digits(threads: None) -> None:
    rng = np.random.default_rng(0)
    guide = cv2.GaussianBlur(rng.integers(0, 255, (201, 333, 3), dtype=np.uint8), (0, 0), 3.0)
    values = rng.uniform(0, 1, (201, 333)).astype(np.float32)
    smooth = []
    for count in (1, 2, 3, 8):
        cv2.setNumThreads(count)
        smooth.append(EdgeSmoother(guide, 30.0, 8.0).filter(values))
        assert cv2.getNumThreads() == count
    for other in smooth[1:]:
        np.testing.assert_array_equal(other, smooth[0])


def test_values_stay_apart_where_the_image_has_an_edge() -> None:
    guide = np.zeros((40, 60, 3), np.uint8)
    guide[:, 30:] = 255
    values = np.where(guide[..., 0] > 0, 2, 1).astype(np.float32)
    values[20, 10] = 9
    smooth = EdgeSmoother(guide, 100.0, 8.0).filter(values)
    np.testing.assert_allclose(smooth[:, 30:], 2, atol=1e-3)
    assert smooth[20, 10] < 1.5
