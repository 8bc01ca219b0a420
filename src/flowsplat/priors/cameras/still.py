"""Tell by the images alone that a camera stands still: most of its edges stay where they are.

Tracks tell that only where most of them rest. Before a dull wall most of what can be followed may be people who walk, and with
a point near enough for each track a camera that turns a little explains them better than one that stands. Where edges of
the median image lie, they rest however much passes before them.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from flowsplat.common.spread import spread
from flowsplat.priors.flow import read_gray
from flowsplat.scenes import Scene

COMPARED_FRAMES = 24
"""Frames that are compared. Chosen by eye."""
WORKING_SIDE = 480
"""Pixels of the longer side at which they are: an edge that stays there to ``MAX_SHIFT`` hardly moves in a larger image.
Chosen by eye."""
GRID = (4, 6)
"""Rows and columns of parts of the image, each of which counts the same: edges of a frame round it, or of the hood of a
car, are the strongest of all and always stay. Chosen by eye."""
EDGE_SHARE, MIN_SLOPE = 0.1, 1.0
"""Share of a part's pixels, with the largest slopes, that are its edges, and gray levels a pixel that an edge has at least. Chosen
by eye."""
MAX_BAR_RANGE, BAR_MARGIN = 8.0, 4
"""Gray levels within a row or column along the border that is a bar round what is shown, and pixels beside it that are left out:
the edge of a bar always stays. Chosen by eye."""
MIN_EDGE_PIXELS = 20
"""Of a part, below which it does not count. Chosen by eye."""
MIN_PARTS = 6
"""Parts with edges below which they do not tell. Chosen by eye."""
MAX_SHIFT = 0.35
"""Pixels, across the edge, up to which it has not moved. Chosen by eye."""
MIN_EDGES_IN_PLACE, MIN_FRAME_SHARE = 0.25, 0.9
"""Share of a part's edges that stay in so many of the frames of a camera that stands still."""
MIN_PARTS_IN_PLACE = 0.3
"""Share of the parts of which that holds: .38 to 1 of cameras that stand still, 0 to .04 of others (docs/method/cameras.md)."""


def stands_still(scene: Scene, frames: Sequence[int]) -> bool:
    """Return whether the camera stands still in some frames of a clip; also False where its edges do not tell."""
    if len(frames) < 2:
        return False
    compared = [frames[k] for k in spread(len(frames), COMPARED_FRAMES)]
    shares = edges_in_place(np.stack([read_gray(scene, i, WORKING_SIDE) for i in compared]))
    return len(shares) >= MIN_PARTS and float((shares >= MIN_EDGES_IN_PLACE).mean()) >= MIN_PARTS_IN_PLACE


def edges_in_place(images: np.ndarray) -> np.ndarray:
    """Return [P], of every part of the image that has edges, which share of them stays in most frames.

    An edge of the median image has moved by as many pixels as an image differs from it there, over its slope.

    Args:
        images: [T, H, W] gray.
    """
    inside = _without_bars(np.median(images, 0))
    smooth = np.stack([cv2.GaussianBlur(image[inside].astype(np.float32), (0, 0), 1.0) for image in images])
    usual = np.median(smooth, 0)
    slope = np.hypot(*(cv2.Sobel(usual, cv2.CV_32F, *axes, scale=1 / 8) for axes in ((1, 0), (0, 1))))
    stays = np.abs(smooth - usual) < MAX_SHIFT * slope
    shares = []
    for rows in np.array_split(np.arange(slope.shape[0]), GRID[0]):
        for columns in np.array_split(np.arange(slope.shape[1]), GRID[1]):
            if not (len(rows) and len(columns)):
                continue
            part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            edges = slope[part] > max(float(np.quantile(slope[part], 1 - EDGE_SHARE)), MIN_SLOPE)
            if edges.sum() >= MIN_EDGE_PIXELS:
                shares.append(np.quantile(stays[:, part[0], part[1]][:, edges].mean(1), 1 - MIN_FRAME_SHARE))
    return np.array(shares)


def _without_bars(image: np.ndarray) -> tuple[slice, slice]:
    """Return rows and columns of an image [H, W] that are not in bars along its border; all of them where nothing else is left."""
    kept = []
    for axis in (0, 1):
        count = image.shape[axis]
        shown = np.flatnonzero(np.ptp(image, 1 - axis) > MAX_BAR_RANGE)
        begin = 0 if not len(shown) or shown[0] == 0 else shown[0] + BAR_MARGIN
        end = count if not len(shown) or shown[-1] == count - 1 else shown[-1] + 1 - BAR_MARGIN
        kept.append(slice(begin, end) if begin < end else slice(0, count))
    return kept[0], kept[1]
