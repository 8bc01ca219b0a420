"""How an object looks where it ends and where it begins: its colors, size, shape and place in the frames next to an absence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.geometry import Camera

LOOKS = 5
"""Frames that are looked at. Chosen by eye."""
LOOK_SECONDS = 0.75
"""Seconds before an end, or after a beginning, that they are taken from. Chosen by eye."""
RIM_SHARE = 0.08
"""Of the square root of its area: the rim of a mask that is left out, for it may show what is behind. Chosen by eye."""
LIGHTNESS_BINS, CHROMA_BINS, CHROMA_REACH = 6, 10, 50
"""Of the histograms of CIE L*a*b*, and how far a* and b* reach from gray; what is more colorful is in the last.
Chosen by eye."""
THIRDS = 3
"""Parts of its height in which colors are compared by themselves: hair, coat and trousers of a person. A round number."""
BORDER_SHARE = 0.01
"""Share of the long side up to which a mask touches the image's border. Chosen by eye."""


@dataclass(frozen=True)
class MaskedFrames:
    """What is looked at, by the position of the frame in the clip.

    Attributes:
        times: [T] seconds.
        pieces: [T] number of the piece within which cameras share a world.
        cameras: [T].
        mask: gives object numbers [H, W] uint8 of a frame.
        image: gives RGB [H, W, 3] uint8 of a frame.
    """

    times: np.ndarray
    pieces: np.ndarray
    cameras: Sequence[Camera]
    mask: Callable[[int], np.ndarray]
    image: Callable[[int], np.ndarray]


@dataclass(frozen=True)
class Appearance:
    """One end of an object.

    Attributes:
        frame: the last one before an absence, or the first one after it.
        colors: [1 + ``THIRDS``, bins] histograms, of all of it and of every third of its height from above, each with sum 1.
        lab: [``THIRDS``, 3] median CIE L*a*b* of every third, each component from 0 to 255.
        height, area: of its mask, pixels and pixels^2 of an image whose long side is 1.
        aspect: height over width.
        middle: [2] pixels, in ``frame``.
        velocity: [2] pixels a second, of its middle.
        borders: [4] bool, whether its mask touches the image's left, upper, right and lower border in ``frame``.
    """

    frame: int
    colors: np.ndarray
    lab: np.ndarray
    height: float
    area: float
    aspect: float
    middle: np.ndarray
    velocity: np.ndarray
    borders: np.ndarray


def look(clip: MaskedFrames, number: int, frames: np.ndarray, areas: np.ndarray, is_end: bool) -> Appearance:
    """Return how an object looks at its end, or at its beginning.

    Args:
        number: in the masks.
        frames: [n] in which it is seen, rising; areas: [n] pixels that it has there.
    """
    if is_end:
        frames, areas = frames[::-1], areas[::-1]
    near = np.abs(clip.times[frames] - clip.times[frames[0]]) <= LOOK_SECONDS
    frames, areas = frames[near], areas[near]
    # What leaves the image is cut by its border, and what goes behind something by that: the largest masks show it best.
    shown = np.sort(np.argsort(-areas, kind="stable")[:LOOKS])
    outlines = {int(frames[k]): clip.mask(int(frames[k])) == number for k in {0, *shown.tolist()}}
    boxes = {k: _box(outline) for k, outline in outlines.items()}
    chosen = [int(frames[k]) for k in shown]
    colors, lab = zip(*(_read_colors(clip.image(k), outlines[k], boxes[k]) for k in chosen), strict=True)
    long_side = max(outlines[chosen[0]].shape)
    heights, widths = (np.array([boxes[k][a + 1] - boxes[k][a] for k in chosen], float) for a in (0, 2))
    histograms = np.sum(colors, 0)
    first, last = int(frames[0]), chosen[-1]
    places = {k: _middle(outlines[k]) for k in (first, last)}
    seconds = float(clip.times[last] - clip.times[first])
    return Appearance(
        first, histograms / np.maximum(histograms.sum(1, keepdims=True), 1e-9), np.median(lab, 0),
        float(np.median(heights)) / long_side, float(np.median(areas[shown])) / long_side**2, float(np.median(heights / widths)),
        places[first], (places[last] - places[first]) / seconds if seconds else np.zeros(2),
        _touches(outlines[first].shape, boxes[first], BORDER_SHARE * long_side),
    )  # fmt: skip


def _box(outline: np.ndarray) -> tuple[int, int, int, int]:
    """Return rows from, to and columns from, to."""
    rows, columns = np.flatnonzero(outline.any(1)), np.flatnonzero(outline.any(0))
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


def _middle(outline: np.ndarray) -> np.ndarray:
    y, x = np.nonzero(outline)
    return np.array([np.median(x), np.median(y)]) + 0.5


def _touches(shape: tuple[int, ...], box: tuple[int, int, int, int], margin: float) -> np.ndarray:
    top, bottom, left, right = box
    return np.array([left <= margin, top <= margin, shape[1] - right <= margin, shape[0] - bottom <= margin])


def _read_colors(image: np.ndarray, outline: np.ndarray, box: tuple[int, int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the histograms [1 + ``THIRDS``, bins] in shares, and the medians [``THIRDS``, 3]."""
    top, bottom, left, right = box
    inside = outline[top:bottom, left:right].astype(np.uint8)
    rim = round(RIM_SHARE * float(np.sqrt(inside.sum())))
    inner = cv2.erode(np.pad(inside, 1), np.ones((2 * rim + 1, 2 * rim + 1), np.uint8))[1:-1, 1:-1]
    y, x = np.nonzero(inner if inner.any() else inside)
    lab = cv2.cvtColor(np.ascontiguousarray(image[top:bottom, left:right]), cv2.COLOR_RGB2LAB)[y, x].astype(np.float64)
    third = np.minimum(THIRDS * y // (bottom - top), THIRDS - 1)
    lightness = np.clip(lab[:, 0] / 256 * LIGHTNESS_BINS - 0.5, 0, LIGHTNESS_BINS - 1)
    chroma = np.clip((lab[:, 1:] - 128 + CHROMA_REACH) / (2 * CHROMA_REACH) * CHROMA_BINS - 0.5, 0, CHROMA_BINS - 1)
    places = np.column_stack([lightness, chroma])
    low = np.minimum(places.astype(int), [LIGHTNESS_BINS - 2, CHROMA_BINS - 2, CHROMA_BINS - 2])
    histograms = np.zeros((THIRDS, LIGHTNESS_BINS, CHROMA_BINS, CHROMA_BINS))
    # A color counts in the bins that it is between, so that a little more light does not move all of it into the next one.
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, places - low, 1 - places + low).prod(1)
        np.add.at(histograms, (third, *(low + corner).T), weight / len(y))
    parts = histograms.reshape(THIRDS, -1)
    every = np.median(lab, 0)
    medians = [np.median(lab[third == k], 0) if (third == k).any() else every for k in range(THIRDS)]
    return np.concatenate([parts.sum(0, keepdims=True), parts]), np.array(medians)
