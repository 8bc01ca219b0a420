"""The input path without its shaking, and the crop that this costs."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from flowsplat.common.progress import report, track
from flowsplat.gaussians.renderer import Renderer
from flowsplat.geometry.paths import crop_camera, smooth_path
from flowsplat.output.videos.shots import MIN_ALPHA, Shot

_MIN_KEPT_SHARE = 0.7
"""Share of width and height that a stabilized video keeps at least; rather than cut more off, it is smoothed less. Chosen by eye.
"""
_PROBE_WIDTH = 160
"""Pixels of the images in which uncovered borders are looked for. Chosen by eye."""
_MARGIN_PIXELS = 1
"""Pixels of these images: Gaussians are blurred to a pixel, so that small images look covered a little further."""


def stabilize(model: Renderer, shots: Sequence[Shot], sigma: float) -> tuple[list[Shot], float]:
    """Smooth a path, and crop all of it alike, so that no uncovered border is seen.

    A camera that is moved off its path sees beyond what the clip has seen. What of an image is covered is asked of the
    scene itself, which knows more than one frame does. Where more than 30 % would have to go, it is smoothed half as much,
    and again. A clip that has uncovered borders already on its own path keeps them, filled from their neighbors.

    Args:
        shots: (camera, seconds) at even steps.
        sigma: shots over which is smoothed (standard deviation).

    Returns:
        the new shots, of the same size, and the share of width and height that they show.
    """
    cameras, times = [camera for camera, _ in shots], [t for _, t in shots]
    candidates = [smooth_path(cameras, sigma / 2**k) for k in range(4)] if sigma > 0 else [cameras]
    for smooth in candidates:
        share = compute_covered_share(model, list(zip(smooth, times, strict=True)))
        if share >= _MIN_KEPT_SHARE:
            break
    else:
        own = compute_covered_share(model, shots)
        smooth = candidates[0] if own < _MIN_KEPT_SHARE else cameras
        share = max(own, _MIN_KEPT_SHARE)
        report("The scene has borders that no frame saw: the stabilized path shows them filled from their neighbors.")
    return [(crop_camera(camera, share), t) for camera, t in zip(smooth, times, strict=True)], share


def compute_covered_share(model: Renderer, shots: Sequence[Shot]) -> float:
    """Return the share of width and height of the largest centered crop that has no uncovered border in any of the shots."""
    first = shots[0][0]
    height = max(round(first.height * _PROBE_WIDTH / first.width), 1)
    width = min(_PROBE_WIDTH, first.width)
    height = min(height, first.height)
    shares = [
        _inner_share(model.render(camera.resize(width, height), t).alpha < MIN_ALPHA)
        for camera, t in track(list(shots), "Looking for uncovered borders")
    ]
    return min(shares)


def _inner_share(uncovered: np.ndarray) -> float:
    """Return the share of one image [H, W] bool; uncovered areas that do not touch the border are holes and do not count."""
    height, width = uncovered.shape
    _, labels = cv2.connectedComponents(uncovered.astype(np.uint8), connectivity=8)
    rim = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    y, x = np.nonzero(np.isin(labels, rim[rim > 0]))
    if not len(x):
        return 1.0
    dx = (np.abs(x + 0.5 - width / 2) - 0.5 - _MARGIN_PIXELS) / (width / 2)
    dy = (np.abs(y + 0.5 - height / 2) - 0.5 - _MARGIN_PIXELS) / (height / 2)
    return float(np.clip(np.maximum(dx, dy).min(), 0, 1))
