"""Textures that are somewhere else in every image."""

from __future__ import annotations

import cv2
import numpy as np


def texture(height: int, width: int, seed: int = 0, blobs: float = 2.0) -> np.ndarray:
    """Gray [H, W] uint8 with blobs of about that many pixels."""
    noise = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), blobs)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def shifted(image: np.ndarray, x: float, y: float, width: int, height: int) -> np.ndarray:
    """The window at (20 - x, 20 - y): its content moves by (x, y)."""
    matrix = np.array([[1, 0, x - 20], [0, 1, y - 20]], np.float32)
    return cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_CUBIC)
