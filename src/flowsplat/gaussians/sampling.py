"""Sample the pixels that become Gaussians: as close together as the image has detail there. Ours."""

from __future__ import annotations

import cv2
import numpy as np

MAX_SPACING_FACTOR = 2.0
"""How many times as far apart as on average they are at most, where there is nothing to see (docs/method/training.md)."""
_DETAIL_SIGMA, _DETAIL_WINDOW = 1.0, 3.0
"""Standard deviations, pixels: what is finer than the first is detail, and it is averaged over the second. Chosen on bear, train
and workshop (docs/method/training.md; docs/notebook/2026-11.md)."""
_DETAIL_FLOOR = 1 / 255
"""Detail that every image has: a step of its own numbers."""
_PROBED_PIXELS = 20_000
"""Pixels that say how many there would be. Chosen by eye."""


def detail(image: np.ndarray) -> np.ndarray:
    """Return how much a slight blur would take from the image around each pixel.

    Args:
        image: [H, W, 3] uint8.

    Returns:
        [H, W] float32, root mean square over the channels, above 0; colors in 0..1.
    """
    colors = image.astype(np.float32) / 255
    lost = colors - cv2.GaussianBlur(colors, (0, 0), _DETAIL_SIGMA)
    square = np.einsum("hwc,hwc->hw", lost, lost) / np.float32(3)
    return np.sqrt(cv2.GaussianBlur(square, (0, 0), _DETAIL_WINDOW)) + np.float32(_DETAIL_FLOOR)


def spacings(weight: np.ndarray, region: np.ndarray, spacing: float) -> np.ndarray:
    """Return share out as many points as an even spacing has in a region: their density follows the weight.

    The density is limited to one point a pixel, and from below by ``MAX_SPACING_FACTOR``.

    Args:
        weight: [H, W] above 0.
        region: [H, W] bool.
        spacing: pixels between two points if they were spread evenly, 1 or more.

    Returns:
        [H, W] float32 pixels between two points, at least 1.
    """
    wanted = 1 / spacing**2
    lowest = wanted / MAX_SPACING_FACTOR**2
    probes = weight[region]
    probes = probes[:: max(1, len(probes) // _PROBED_PIXELS)]
    if len(probes) == 0:
        return np.full(weight.shape, spacing, np.float32)
    low, high = lowest / probes.max(), 1 / probes.min()
    for _ in range(30):
        middle = (low * high) ** 0.5
        if np.clip(middle * probes, lowest, 1).mean() > wanted:
            high = middle
        else:
            low = middle
    return 1 / np.sqrt(np.clip(low * weight, lowest, 1))


def grid(width: int, height: int, spacing: float | np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return [H, W] bool: about one pixel every ``spacing`` pixels.

    Args:
        spacing: 1 or more: one number, or [H, W] one at every pixel.
        rng: for where the pattern begins.
    """
    # Sums of multiples of these two numbers (powers of 1 / 1.3247, the plastic ratio) are spread evenly, without clumps.
    sums = 0.7548776662466927 * np.arange(width) + (0.5698402909980532 * np.arange(height) + rng.random())[:, None]
    return sums - np.floor(sums) < 1 / spacing**2
