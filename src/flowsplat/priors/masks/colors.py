"""Learn the colors of the objects of a clip, and of what is round them."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

BIN_WIDTHS = (8, 4, 4)
"""Width of a bin of the histograms in L, a, b. Chosen by eye."""

SURROUNDINGS_REACH = 0.07
"""Share of the long side within which colors are those round an object. Chosen by eye."""

MIN_COLOR_PIXELS = 200
"""Pixels of objects that make a model. Chosen by eye."""

_SHAPE = tuple(256 // step for step in BIN_WIDTHS)
_MIN_COLOR_SHARE = 1e-5
"""Share of all pixels at which a color is neither's. Chosen by eye."""


class ColorModel:
    """Histograms in Lab of objects and of what surrounds them, over the frames that were added."""

    def __init__(self) -> None:
        self._counts = np.zeros((2, int(np.prod(_SHAPE))))

    def add(self, frame: np.ndarray, moving: np.ndarray) -> None:
        """Take a frame RGB [H, W, 3] uint8 with its objects bool [H, W]."""
        margin = int(SURROUNDINGS_REACH * max(moving.shape))
        near = cv2.dilate(moving.astype(np.uint8), np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)) > 0
        bins = _bins(frame)
        for number, chosen in enumerate((near & ~moving, moving)):
            self._counts[number] += np.bincount(bins[chosen], minlength=self._counts.shape[1])

    def table(self) -> np.ndarray | None:
        """For every bin the logarithm to base 2 of how much more often objects have its color; None without objects."""
        if self._counts.sum(1).min() < MIN_COLOR_PIXELS:
            return None
        shares = np.stack([gaussian_filter(count.reshape(_SHAPE), 1.0) for count in self._counts])
        shares /= shares.sum((1, 2, 3), keepdims=True)
        return np.log2((shares[1] + _MIN_COLOR_SHARE) / (shares[0] + _MIN_COLOR_SHARE)).astype(np.float32).ravel()


def look_up(table: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Return the values [H, W] of a table for the colors of a frame RGB [H, W, 3] uint8."""
    return table[_bins(frame)]


def _bins(frame: np.ndarray) -> np.ndarray:
    """Return the bin of every pixel, [H, W] int."""
    lab = cv2.cvtColor(frame, cv2.COLOR_RGB2LAB) // np.array(BIN_WIDTHS, np.uint8)
    return np.ravel_multi_index(tuple(lab.transpose(2, 0, 1).astype(np.int64)), _SHAPE)
