"""Fill scattered, weighted inverse depth in to a value for every pixel, along the edges of the image."""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.images.edge_smoothing import EdgeSmoother

EDGE_AWARE_SMOOTHNESS = 30.0
"""Of the smoother along the edges of the image, as in the fast global smoother. Chosen by eye."""

SMOOTHED_WEIGHT = 50.0
"""Weight of a smoothed value against that of the value itself. Chosen by eye."""

TREND_SMOOTHNESS = 10_000.0
"""Of the trend, which knows no edges. Chosen by eye."""

TREND_WEIGHT = 0.1
"""Weight of the trend. Chosen by eye."""

COLOR_SIGMA = 8.0
"""Gray levels across which the smoother no longer reaches. Chosen by eye."""


def fill(
    values: np.ndarray, weights: np.ndarray, guide: np.ndarray, smoothness: float = EDGE_AWARE_SMOOTHNESS
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted edge-aware smoothing (fast global smoother, https://doi.org/10.1109/TIP.2014.2366600).

    The smoother prefers constant surfaces; a value of large weight is therefore kept, and the smoothed one only helps
    out with a weight of ``SMOOTHED_WEIGHT``. What has hardly any support within its edges follows the trend across them.

    Args:
        values: [h, w] float32; where the weight is 0 they do not count.
        weights: [h, w] float32 >= 0.
        guide: RGB [h, w, 3] uint8.

    Returns:
        Values [h, w] float32 and the smoothed weights [h, w] float32 that support them. Without any weight all values
        are the mean of the input.
    """
    smoother = EdgeSmoother(guide, smoothness, COLOR_SIGMA)
    broad = EdgeSmoother(np.zeros_like(guide), TREND_SMOOTHNESS, COLOR_SIGMA)
    known = weights > 0
    center = float(np.average(values[known], weights=weights[known])) if known.any() else float(values.mean())
    # Smoothed about the mean, so that the floor of the weights pulls nowhere but to it.
    offsets = np.where(known, values - center, 0).astype(np.float32)
    weights = weights.astype(np.float32)
    support = smoother.filter(weights)
    floor = np.float32(1e-6 * max(float(weights.max()), 1e-12))
    trend = broad.filter(offsets * weights) / np.maximum(broad.filter(weights) + floor, 1e-30)
    smooth = (smoother.filter(offsets * weights) + TREND_WEIGHT * trend) / (support + TREND_WEIGHT)
    blended = (weights * offsets + SMOOTHED_WEIGHT * smooth) / (weights + SMOOTHED_WEIGHT)
    return (blended + center).astype(np.float32), support


def upsample(values: np.ndarray, guide: np.ndarray, width: int, height: int) -> np.ndarray:
    """Half resolution [h, w] to [height, width]: bilinear, then pulled to the edges of the guide [height, width, 3]."""
    large = cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)
    return EdgeSmoother(guide, 4.0, COLOR_SIGMA).filter(large)
