"""Depth of moving objects: upright billboards that stand where the scene behind them ends.

Matches say nothing about the depth of what moves. But every static point that other frames show at the pixels of a
object lies behind it: these points are its clean plate. The nearest of them is the ground at its feet, if it stands on
the ground, and in any case the furthest it can be away. So an object is as near as the near end of its plate, and no pixel
of it lies behind the plate, or behind what frames far away in time saw there (docs/method/depth.md: that an
object is before the
background matters more than how far before). How its depth changes is seen from its size, so that the frames with the
nearest plate speak for all.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d, percentile_filter

from flowsplat.common.progress import track
from flowsplat.common.threads import in_threads, thread_count
from flowsplat.images.edge_smoothing import one_thread
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.static_depth import StaticDepth
from flowsplat.scenes.layers import TRUSTED_CONFIDENCE

PLATE_PERCENTILE = 92.0
"""Percentile of the plate's inverse depth at which an object stands: not the nearest pixel, which a leak of the mask may hold.
Chosen by eye."""

COMPARED_FRAMES, WINDOW_PERCENTILE = 121, 88
"""Training frames whose billboards are compared, and the percentile of their inverse depth, at one size, that is taken.
Chosen by eye."""

SMOOTHING_SIGMA = 8.0
"""Training frames: standard deviation of the smoothing over time of how large an object would be at its billboard's depth.
Chosen by eye."""

GROWTH_BELIEF = 0.7
"""How much of an object's growth is due to its depth: flow is noisy, and what turns or bends grows too. Chosen by eye."""

MIN_GROWTH_PIXELS = 40
"""Trusted working pixels of an object that tell its growth. Chosen by eye."""

_REWEIGHTING_ROUNDS = 4
"""Rounds of reweighting of the fit of an object's growth. Chosen by eye."""


def place_billboard(mask: np.ndarray, plate: np.ndarray) -> float:
    """Return inverse depth of the upright billboard that stands for one object (bool [h, w]) in front of its plate [h, w].

    The nearer of the near end of the plate inside the object, and the ground just below its lowest part.
    """
    kernel = np.ones((5, 5), np.uint8)
    inside = cv2.erode(mask.astype(np.uint8), kernel) > 0
    near_end = np.percentile(plate[inside if inside.sum() >= 20 else mask], PLATE_PERCENTILE)
    rows, columns = np.nonzero(mask)
    extent = rows.max() - rows.min()
    foot = columns[rows >= rows.max() - max(2, extent // 12)]
    left, right = np.percentile(foot, [5, 95]).astype(int)
    below = min(rows.max() + extent // 20, mask.shape[0] - 1)
    return float(max(near_end, np.median(plate[below - 1 : below + 1, left : right + 1])))


def growth(mask: np.ndarray, flow: np.ndarray, confidence: np.ndarray) -> float:
    """Return logarithm of how many times larger an object (bool [h, w]) is where its flow [h, w, 2] leads; 0 where that is unknown.

    From the affine map that explains most of the flow inside the object, by reweighted least squares.
    """
    inside = (cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0) & (confidence >= TRUSTED_CONFIDENCE)
    if inside.sum() < MIN_GROWTH_PIXELS:
        return 0.0
    rows, columns = np.nonzero(inside)
    places = np.stack([columns - columns.mean(), rows - rows.mean(), np.ones(len(rows))], 1)
    moved, weights = flow[inside].astype(np.float64), np.ones(len(rows))
    for _ in range(_REWEIGHTING_ROUNDS):
        fit = np.linalg.lstsq(places * weights[:, None], moved * weights[:, None], rcond=None)[0]
        off = np.linalg.norm(moved - places @ fit, axis=1)
        weights = 1 / np.sqrt(1 + (off / max(float(np.median(off)), 0.05)) ** 2)
    return float(0.5 * np.log(max(np.linalg.det(np.eye(2) + fit[:2]), 0.5)))


def smooth_billboards(billboards: np.ndarray, growths: np.ndarray, pieces: np.ndarray) -> np.ndarray:
    """Return inverse depths [T] of one object over time, NaN where it is not seen, smoothed; stays NaN there.

    An object that is twice as large in the image is twice as near. At one size the near end of a window counts: what
    an object passes in front of at one time bounds its distance at others. Either side of a cut is a world of its own.

    Args:
        growths: [T] logarithm of how much larger the object became since the frame before.
        pieces: [T] number of the piece of the clip.
    """
    smooth = np.full(len(billboards), np.nan)
    for piece in np.unique(pieces):
        part = pieces == piece
        smooth[part] = _smooth_piece(billboards[part], growths[part])
    return smooth


def _smooth_piece(billboards: np.ndarray, growths: np.ndarray) -> np.ndarray:
    seen = np.isfinite(billboards)
    if not seen.any():
        return billboards
    nearness = GROWTH_BELIEF * np.cumsum(growths)
    at_one_size = np.interp(np.arange(len(billboards)), np.flatnonzero(seen), np.log(billboards[seen]) - nearness[seen])
    near = percentile_filter(at_one_size, WINDOW_PERCENTILE, size=COMPARED_FRAMES, mode="nearest")
    return np.where(seen, np.exp(gaussian_filter1d(near, SMOOTHING_SIGMA, mode="nearest") + nearness), np.nan)


def make_billboards(clip: MatchedClip, background: StaticDepth) -> dict[int, np.ndarray]:
    """Smoothed inverse depth [T] of every object over the training frames."""

    def seen(k: int) -> tuple[dict[int, float], dict[int, float], dict[int, float]]:
        """Return the billboard of every object in a frame, and how much larger it is in the frame before and in the next one."""
        mask = clip.mask(k)
        numbers = [int(number) for number in np.unique(mask[mask > 0])]
        here = {number: place_billboard(mask == number, background.compute_foremost(k)) for number in numbers}
        return here, _growths(clip, k, k - 1, mask), _growths(clip, k, k + 1, mask)

    with one_thread():
        found = list(in_threads(seen, track(range(len(clip)), "Depth of objects"), thread_count()))
    billboards: dict[int, np.ndarray] = {}
    growths: dict[int, np.ndarray] = {}
    before: dict[int, float] = {}
    for k, (here, back, ahead) in enumerate(found):
        for number, value in here.items():
            billboards.setdefault(number, np.full(len(clip), np.nan))[k] = value
            both = growths.setdefault(number, np.zeros(len(clip)))
            if number in before and number in back:
                both[k] = (before[number] - back[number]) / 2
        before = ahead
    pieces = np.asarray(clip.continuity.pieces)
    return {number: smooth_billboards(values, growths[number], pieces) for number, values in billboards.items()}


def _growths(clip: MatchedClip, k: int, j: int, mask: np.ndarray) -> dict[int, float]:
    """Return logarithm of how much larger the objects of training frame ``k`` are in its neighbor ``j``."""
    if not mask.any() or not 0 <= j < len(clip) or not clip.continuity.are_joined(k, j):
        return {}
    flow, confidence = clip.step_flow(k, j)
    return {int(number): growth(mask == number, flow, confidence) for number in np.unique(mask[mask > 0])}
