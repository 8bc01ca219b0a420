"""Fade a view into the window where nothing is left of what the clip has seen.

The exported page fades likewise (``player/assets``), but more: all that the clip does not tell (``gaussians.confidence_fade``).
"""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.output.viewer.layout import BAR_GRAY

MASK_SIDE = 24
"""Pixels of the longer side of the small image that tells where nothing is left around. As in the page."""
KEPT_FROM, KEPT_TO = 0.35, 0.65
"""Alpha of that image, up to which a view is gone, and from which it is there. As in the page."""


def compute_kept(alpha: np.ndarray) -> np.ndarray:
    """Return [H, W] float32, 0 to 1, how much of a view of alpha [H, W] is shown: small gaps are, bare sides are not."""
    around = alpha
    while max(around.shape) > MASK_SIDE:
        size = (max(around.shape[1] // 2, 1), max(around.shape[0] // 2, 1))
        around = cv2.resize(around, size, interpolation=cv2.INTER_AREA)
    share = (cv2.resize(around, alpha.shape[::-1], interpolation=cv2.INTER_LINEAR) - KEPT_FROM) / (KEPT_TO - KEPT_FROM)
    share = np.clip(share, 0, 1)
    return np.asarray(share**2 * (3 - 2 * share), np.float32)


def fade_into_window(image: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return [H, W, 3] uint8: so much [H, W] of an image, and of the window's gray what is left."""
    share = kept[..., None]
    return np.asarray(np.rint(share * image + (1 - share) * BAR_GRAY), np.uint8)
