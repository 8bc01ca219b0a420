"""Images that show nothing."""

from __future__ import annotations

import cv2
import numpy as np

MAX_BLANK_SIGMA = 3.0
"""Standard deviation in gray levels below which an image is called blank: black, white, or the noise of a dark sensor.
Chosen by eye."""


def is_blank(image: np.ndarray) -> bool:
    """Return whether gray [H, W] or RGB [H, W, 3] uint8 shows nothing that could be matched."""
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return float(gray.std()) < MAX_BLANK_SIGMA
