"""Measure sharpness: how much of the fine detail of an image another one reproduces, and how much contrast it has there.

PSNR does not tell blurred images from displaced, noisy or differently exposed ones. Here both images are reduced to a band of high
frequencies, b (the image) and t (its target), and compared in blocks in which the target has detail:

    detail   = max over s of mean(b_s t) / mean(t^2), with b_s the image displaced by s, two pixels at most
    contrast = sqrt(mean(b^2) / mean(t^2))

both at most 1. A blur takes as much from both. Detail that stands a pixel or two beside its place counts as reproduced; farther
away, or another one, it is lost although there is contrast.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

BAND_SIGMAS = (1.0, 3.0)
"""Standard deviations in pixels of the two Gaussians whose difference is the band. A narrower one has more of the noise, and a
blur of two pixels leaves no more of it than of detail that is wrong."""
STRIDE = 2
"""Pixels between two values that are kept of the band, which has hardly anything finer, and by which detail may be displaced."""
BLOCK_SIDE = 16
"""Pixels. Chosen by eye."""
MIN_CONTRAST = 4 / 255
"""Standard deviation in the band from which a block has detail. Chosen by eye."""
MIN_BLOCKS = 4
"""Blocks with detail below which an image, or a part of it, tells nothing. Chosen by eye."""
MIN_FILLED_SHARE = 0.25
"""Share of a block that has to be in a region. Chosen by eye."""
_STEPS = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)]


class Sharpness(NamedTuple):
    """Of an image, both 0 to 1, means over the blocks in which the target has detail.

    Attributes:
        detail: share of it that the image reproduces.
        contrast: of the image over that of the target.
    """

    detail: float
    contrast: float


class DetailPair:
    """An image and its target in the band of fine detail.

    Examples:
        >>> target = np.random.default_rng(0).random((64, 64, 3))
        >>> [round(value, 3) for value in DetailPair(target, target).measure()]
        [1.0, 1.0]
        >>> DetailPair(target, np.full((64, 64, 3), 0.5)).measure() is None
        True
    """

    def __init__(self, image: np.ndarray, target: np.ndarray):
        """Of two float images [H, W, 3], RGB from 0 to 1."""
        self._image, self._target = _band(image), _band(target)

    def measure(self, mask: np.ndarray | None = None) -> Sharpness | None:
        """Return how sharp the image is.

        Args:
            mask: [H, W] bool; what is outside does not count.

        Returns:
            None where the target has detail in fewer than ``MIN_BLOCKS`` blocks.
        """
        image, target, filled = self._image, self._target, np.ones((), np.float32)
        if mask is not None:
            inside = np.ascontiguousarray(mask[::STRIDE, ::STRIDE], np.float32)
            image, target, filled = image * inside, target * inside, _average(inside)
        variance = _average(target * target)
        has_detail = (variance >= MIN_CONTRAST**2 * filled) & (filled >= MIN_FILLED_SHARE)
        if int(has_detail.sum()) < MIN_BLOCKS:
            return None
        of_target = variance[has_detail]
        # Displaced, the whole image counts: what comes from outside the mask is the same detail.
        shares = [_average(target * np.roll(self._image, step, (1, 0)))[has_detail] for step in _STEPS]
        detail = np.clip(np.max(shares, axis=0) / of_target, 0, 1)
        contrast = np.minimum(np.sqrt(_average(image * image)[has_detail] / of_target), 1)
        return Sharpness(float(detail.mean()), float(contrast.mean()))


def _band(image: np.ndarray) -> np.ndarray:
    """Return [ceil(H / STRIDE), ceil(W / STRIDE)] float32."""
    narrow, wide = BAND_SIGMAS
    gray = cv2.cvtColor(np.clip(image, 0, 1).astype(np.float32), cv2.COLOR_RGB2GRAY)
    fine = np.ascontiguousarray(cv2.GaussianBlur(gray, (0, 0), narrow)[::STRIDE, ::STRIDE])
    return fine - cv2.GaussianBlur(fine, (0, 0), (wide**2 - narrow**2) ** 0.5 / STRIDE)


def _average(values: np.ndarray) -> np.ndarray:
    """Return means over whole blocks; of an image that is smaller than a block, over all of it."""
    side = BLOCK_SIDE // STRIDE
    height, width = (max(size // side, 1) for size in values.shape)
    return cv2.resize(values[: height * side, : width * side], (width, height), interpolation=cv2.INTER_AREA)
