"""Measure how far an image, a flow or a depth is from the truth: pure functions on NumPy arrays, computed in float64.

Region metrics (docs/method/evaluation.md) average inside a mask. A region too small to say anything gives None, never
NaN.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

MIN_PIXELS = 50
"""Regions with fewer pixels are not measured."""

MAX_PSNR = 100.0
"""dB; identical images get this instead of infinity, so that means and JSON stay finite."""

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
"""Side in pixels and standard deviation of the window of SSIM, as in Wang et al. 2004 (docs/method/evaluation.md)."""
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
"""The constants of SSIM, (0.01 L)^2 and (0.03 L)^2 for values up to L = 1, as in Wang et al. 2004."""


def _inside(values: np.ndarray, mask: np.ndarray | None) -> np.ndarray | None:
    """Return the values [N, ...] of the pixels in ``mask`` (None = all), or None where those are too few."""
    selected = values.reshape(-1, *values.shape[2:]) if mask is None else values[np.asarray(mask, bool)]
    return selected if len(selected) >= MIN_PIXELS else None


def mean_inside(values: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Return the mean of a map [H, W, ...] over the pixels in ``mask`` [H, W] bool; None for fewer than ``MIN_PIXELS`` of them."""
    selected = _inside(values, mask)
    return None if selected is None else float(selected.mean())


def _clip(image: np.ndarray) -> np.ndarray:
    return np.clip(np.asarray(image, np.float64), 0, 1)


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Peak signal-to-noise ratio in dB of two float images [H, W, 3], clipped to [0, 1].

    Args:
        mask: [H, W] bool; the squared error is averaged inside it.

    Returns:
        At most ``MAX_PSNR``; None for fewer than ``MIN_PIXELS`` pixels.

    >>> gray = np.full((8, 8, 3), 0.5)
    >>> round(psnr(gray, gray + 0.1), 3), psnr(gray, gray), psnr(gray, gray, np.zeros((8, 8), bool))
    (20.0, 100.0, None)
    """
    squared = mean_inside((_clip(a) - _clip(b)) ** 2, mask)
    return None if squared is None else float(-10 * np.log10(max(squared, 10 ** (-MAX_PSNR / 10))))


def _blur(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (SSIM_WINDOW, SSIM_WINDOW), SSIM_SIGMA, borderType=cv2.BORDER_REFLECT_101)


def ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the structural similarity of two float images, clipped to [0, 1], at every pixel and channel, [H, W, 3] float64.

    Wang et al. 2004 (https://doi.org/10.1109/TIP.2003.819861): 11x11 Gaussian window of sigma 1.5, K1 = 0.01,
    K2 = 0.03, data range 1. The image is mirrored at its border, so that the map has its size, as in
    torchmetrics.

    >>> ramp = np.linspace(0, 1, 16 * 16 * 3).reshape(16, 16, 3)
    >>> round(float(ssim_map(ramp, ramp).mean()), 6), bool(ssim_map(ramp, 1 - ramp).mean() < 0.5)
    (1.0, True)
    """
    return _ssim_of(_clip(a), _clip(b), _blur)


def _ssim_of(a: np.ndarray, b: np.ndarray, average: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the map of two images; ``average`` gives the mean of a window about every pixel."""
    mean_a, mean_b = average(a), average(b)
    var_a = np.maximum(average(a * a) - mean_a**2, 0)
    var_b = np.maximum(average(b * b) - mean_b**2, 0)
    covariance = average(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a**2 + mean_b**2 + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (var_a + var_b + SSIM_C2)
    return luminance * structure


def compute_masked_ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float | None:
    """Structural similarity of which only the pixels in ``mask`` [H, W] bool know anything; mean over these.

    As ``ssim_map``, but every mean of a window is that of its pixels inside the mask (a partial convolution), so that what the clip
    never saw counts nowhere: as the mSSIM of DyCheck (https://arxiv.org/abs/2210.13445, section 4), whose
    own code also averages over pixels that the clip never saw, so figures of both cannot be compared.

    Returns:
        None for fewer than ``MIN_PIXELS`` pixels.

    >>> ramp = np.linspace(0, 1, 16 * 16 * 3).reshape(16, 16, 3)
    >>> left = np.arange(16) < np.full((16, 1), 8)
    >>> round(compute_masked_ssim(ramp, np.where(left[..., None], ramp, 0), left), 6)
    1.0
    """
    weights = np.maximum(_blur(mask.astype(np.float64)), 1e-12)[..., None]

    def inside(values: np.ndarray) -> np.ndarray:
        return _blur(values * mask[..., None]) / weights

    return mean_inside(_ssim_of(_clip(a), _clip(b), inside), mask)


def end_point_error(flow: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> dict[str, float] | None:
    """Length in pixels of the difference of two flows [H, W, 2] inside ``valid`` [H, W] bool.

    Returns:
        ``mean`` and ``median``; None for fewer than ``MIN_PIXELS`` pixels.

    >>> end_point_error(np.zeros((8, 8, 2)), np.full((8, 8, 2), [3.0, 4.0]), np.ones((8, 8), bool))
    {'mean': 5.0, 'median': 5.0}
    """
    lengths = np.linalg.norm(np.asarray(flow, np.float64) - np.asarray(truth, np.float64), axis=-1)
    return _mean_and_median(_inside(lengths, valid))


def depth_abs_rel(depth: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> dict[str, float] | None:
    """|depth - truth| / truth inside ``valid`` [H, W] bool; both [H, W] and in the same unit.

    Returns:
        ``mean`` (the field's AbsRel) and ``median``; None for fewer than ``MIN_PIXELS`` pixels.

    >>> depth_abs_rel(np.full((8, 8), 1.5), np.full((8, 8), 2.0), np.ones((8, 8), bool))
    {'mean': 0.25, 'median': 0.25}
    """
    pairs = _inside(np.stack([depth, truth], -1).astype(np.float64), valid)
    if pairs is None:
        return None
    estimate, reference = pairs.T
    return _mean_and_median(np.abs(estimate - reference) / reference)


def _mean_and_median(values: np.ndarray | None) -> dict[str, float] | None:
    return None if values is None else {"mean": float(values.mean()), "median": float(np.median(values))}
