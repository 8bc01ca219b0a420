"""Images on a canvas of another shape: fitted with bars, beside each other, one over the other with a wipe."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

BAR_GRAY = 20
"""Gray value of what is beside an image. Chosen by eye."""


@dataclass(frozen=True)
class Box:
    """Where an image lies on a canvas, in pixels."""

    x: int
    y: int
    width: int
    height: int

    @property
    def rows_and_columns(self) -> tuple[slice, slice]:
        """Its place in an array."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)


def fit_box(size: tuple[int, int], room: Box) -> Box:
    """Return the largest box with the shape of ``size`` (width, height) in the middle of ``room``."""
    scale = min(room.width / size[0], room.height / size[1])
    width, height = max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)
    return Box(room.x + (room.width - width) // 2, room.y + (room.height - height) // 2, width, height)


def halves(size: tuple[int, int]) -> tuple[Box, Box]:
    """Return the left and the right half of a canvas (width, height)."""
    middle = max(size[0] // 2, 1)
    return Box(0, 0, middle, size[1]), Box(middle, 0, max(size[0] - middle, 1), size[1])


def empty(size: tuple[int, int]) -> np.ndarray:
    """Return [H, W, 3] uint8: a canvas (width, height) with nothing on it."""
    return np.full((size[1], size[0], 3), BAR_GRAY, np.uint8)


def place(canvas: np.ndarray, image: np.ndarray, box: Box) -> None:
    """Draw ``image`` [h, w, 3] uint8 into a box of the canvas, resized to it."""
    if image.shape[:2] != (box.height, box.width):
        method = cv2.INTER_AREA if box.height < image.shape[0] else cv2.INTER_LINEAR
        image = cv2.resize(image, (box.width, box.height), interpolation=method)
    target = canvas[box.rows_and_columns]
    target[:] = image[: target.shape[0], : target.shape[1]]


def wipe(image: np.ndarray, over: np.ndarray, share: float) -> np.ndarray:
    """``over`` on the left ``share`` of ``image`` (both [H, W, 3] uint8, of one size), a line between them."""
    result = image.copy()
    column = round(np.clip(share, 0, 1) * image.shape[1])
    result[:, :column] = over[:, :column]
    if 0 < column < image.shape[1]:
        result[:, max(column - 1, 0) : column + 1] = 255
    return result
