"""Smoothing along the edges of an image, with the same result on every machine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np


class EdgeSmoother:
    """The fast global smoother (https://doi.org/10.1109/TIP.2014.2366600) of OpenCV, guided by an image.

    With several threads OpenCV cuts the image into strips, whose last columns are computed in another order of operations: the
    last digits would depend on the number of cores. It is one of few filters where they do, and cheap, so it has one thread.
    """

    def __init__(self, guide: np.ndarray, smoothness: float, color_sigma: float):
        """
        Args:
            guide: RGB [H, W, 3] uint8.
            smoothness: lambda of the paper.
            color_sigma: gray levels across which it no longer reaches.
        """
        with one_thread():
            self._filter = cv2.ximgproc.createFastGlobalSmootherFilter(np.ascontiguousarray(guide), smoothness, color_sigma)

    def filter(self, values: np.ndarray) -> np.ndarray:
        """Smooth values [H, W] float32."""
        with one_thread():
            smooth: np.ndarray = self._filter.filter(values)
        return smooth


@contextmanager
def one_thread() -> Iterator[None]:
    """Inside, OpenCV has one thread, in all of the program: who has threads of their own that smooth is inside of it, too."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
