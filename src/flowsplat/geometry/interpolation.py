"""Values of a map between its pixels."""

from __future__ import annotations

import cv2
import numpy as np

_REMAP_ROW_LENGTH = 16384
"""Points in a row given to ``cv2.remap``, which takes at most 32767."""


def sample_map(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Bilinear samples [N, C] of a map [H, W] or [H, W, C <= 4] at pixel positions [N, 2] (centers at +0.5).

    Outside the map its border continues. The precision of a position is 1/32 pixel.
    """
    channels = 1 if values.ndim == 2 else values.shape[2]
    count = len(points)
    rows = -(-count // _REMAP_ROW_LENGTH)
    if rows == 0:
        return np.zeros((0, channels), values.dtype)
    where = np.zeros((rows * min(count, _REMAP_ROW_LENGTH), 2), np.float32)
    where[:count] = np.nan_to_num(points, nan=-1.0, posinf=1e6, neginf=-1e6) - 0.5
    x, y = where.reshape(rows, -1, 2).transpose(2, 0, 1).copy()
    sampled = cv2.remap(np.ascontiguousarray(values), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled.reshape(-1, channels)[:count]
