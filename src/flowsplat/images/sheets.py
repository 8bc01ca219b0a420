"""Images beside each other on one sheet, each with its name."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from flowsplat.images.colors import error_to_color, float_to_bytes

GAP_PIXELS = 4
"""Pixels between two images. Chosen by eye."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_RULER_WIDTH = 26
"""Pixels of a ruler beside an image. Chosen by eye."""
_MIN_TICK_SPACING = 40
"""Pixels between two numbers of a ruler, at least. Chosen by eye."""
_TICK_STEPS = (5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000)
"""Pixels between two numbers of a ruler: the smallest that leaves ``_MIN_TICK_SPACING``."""


def side_by_side(images: Sequence[np.ndarray], labels: Sequence[str] = (), height: int | None = None) -> np.ndarray:
    """Return one row of images [h, w, 3], gray or color, uint8 or float between 0 and 1.

    Args:
        labels: one for every image, or none at all. Plain ASCII.
        height: of the sheet, in pixels; None = that of the first image. The others are resized to it.

    Returns:
        [height, W, 3] uint8.
    """
    height = height or images[0].shape[0]
    panels = [_resize(_convert_to_color(image), height) for image in images]
    for panel, label in zip(panels, labels, strict=bool(labels)):
        _write_label(panel, label)
    gap = np.full((height, GAP_PIXELS, 3), 255, np.uint8)
    return np.concatenate([part for panel in panels for part in (gap, panel)][1:], axis=1)


def stack(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Sheets under each other, the narrower ones resized to the width of the first; [H, width, 3] uint8."""
    width = rows[0].shape[1]
    gap = np.full((GAP_PIXELS, width, 3), 255, np.uint8)
    panels = [_resize(row, max(round(row.shape[0] * width / row.shape[1]), 1), width) for row in rows]
    return np.concatenate([part for panel in panels for part in (gap, panel)][1:])


def with_rulers(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the image [h, w, 3] uint8 with rulers above and to the left of it, so that a place in it can be named in pixels.

    Args:
        size: (width, height) in the pixels that the rulers count; their origin is the outer corner of the first pixel.
    """
    height, width = image.shape[:2]
    step = next(step for step in _TICK_STEPS if step >= _MIN_TICK_SPACING * size[0] / width)
    sheet = np.full((height + _RULER_WIDTH, width + _RULER_WIDTH, 3), 255, np.uint8)
    sheet[_RULER_WIDTH:, _RULER_WIDTH:] = image
    for across, (length, count) in ((True, (width, size[0])), (False, (height, size[1]))):
        for value in range(0, count, step // 5):
            at = _RULER_WIDTH + min(round(value * length / count), length - 1)
            whole = value % step == 0
            tick = _RULER_WIDTH - (8 if whole else 4)
            along = slice(tick, _RULER_WIDTH)
            sheet[(along, at) if across else (at, along)] = 90
            if whole:
                place = (at + 2, 12) if across else (0, at + 10)
                cv2.putText(sheet, str(value), place, _FONT, 0.32, (60, 60, 60), 1, cv2.LINE_AA)
    return sheet


def preview_sheet(target: np.ndarray, rendering: np.ndarray) -> np.ndarray:
    """Return how training goes: target | rendering | error. Images [H, W, 3] uint8 or float."""
    return side_by_side([target, rendering, error_to_color(target, rendering)], ["target", "rendering", "error"])


def _convert_to_color(image: np.ndarray) -> np.ndarray:
    image = float_to_bytes(image)
    return np.repeat(image[..., None], 3, -1) if image.ndim == 2 else image


def _resize(image: np.ndarray, height: int, width: int | None = None) -> np.ndarray:
    """Return a copy of the image at that height, and at that width or one that keeps its shape."""
    width = width or max(round(image.shape[1] * height / image.shape[0]), 1)
    if image.shape[:2] == (height, width):
        return image.copy()
    method = cv2.INTER_AREA if height < image.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), None, 0, 0, method)


def _write_label(panel: np.ndarray, label: str) -> None:
    """White letters on a darkened strip in the top left corner, sized to the image."""
    scale = float(np.clip(panel.shape[0] / 600, 0.3, 1.2))
    (width, height), below = cv2.getTextSize(label, _FONT, scale, 1)
    margin = max(round(6 * scale), 2)
    corner = panel[: height + below + 2 * margin, : width + 2 * margin]
    corner[:] = corner // 3
    place = (margin, margin + height)
    cv2.putText(panel, label, place, _FONT, scale, (255, 255, 255), 1, cv2.LINE_AA)
