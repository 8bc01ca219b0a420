"""Flow of what moves, once it is known what moves: searched again without what is behind it.

A fast or thin limb has little room in the windows of a search among what rests, and that wins. With all that rests in one gray the
outline is the strongest thing in the image. Of both flows every pixel takes that which leads to its color, into a mask and back.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise

import cv2
import numpy as np

from flowsplat.common.progress import track
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.priors.continuity import Continuity
from flowsplat.priors.flow import dis_flow, forward_backward_confidence, gray, lengths
from flowsplat.scenes import Flow, Scene

MIN_TRUSTED_SHARE = 0.95
"""Share of the objects' pixels with trusted flow, both ways, from which it is good enough (docs/method/flow.md)."""
SEARCH_MARGIN = 48
"""Pixels around the objects of two frames that are searched with them. Chosen by eye."""
REST_GRAY = 127
"""What rests is painted in it."""
MAX_COLOR_DIFFERENCE = 60.0
"""Gray levels beyond which it makes no difference how much colors differ. Chosen by eye."""
OUTSIDE_COST = 20.0
"""Gray levels that a place outside the masks counts as. Chosen by eye."""
ROUND_TRIP_DIFFERENCE, MAX_ROUND_TRIP_LIMITS = 3.0, 4.0
"""The same of a round trip that misses by its limit (``forward_backward_confidence``), and by how many limits it counts at most.
Chosen by eye."""
WINDOW_SIGMA = 2.0
"""Standard deviation in pixels of the window over which flows are compared (docs/method/flow.md)."""


def object_flow_stage(scene: Scene, kept: Collection[tuple[int, int]] = ()) -> None:
    """Search the flow between consecutive training frames again inside the masks; what rests keeps what it has.

    Args:
        kept: pairs that stay as they are.
    """
    continuity = Continuity(scene)
    for k, (i, j) in enumerate(track(list(pairwise(scene.train_frames)), "Flow of objects")):
        masks = scene.mask(i) > 0, scene.mask(j) > 0
        if {(i, j), (j, i)} <= set(kept) or not (masks[0].any() and masks[1].any() and continuity.are_joined(k, k + 1)):
            continue
        flows = scene.flow(i, j), scene.flow(j, i)
        if min(float(flow.trusted[mask].mean()) for flow, mask in zip(flows, masks, strict=True)) >= MIN_TRUSTED_SHARE:
            continue
        better = _search((scene.frame(i), scene.frame(j)), masks, (flows[0].flow, flows[1].flow))
        for flow, found, back, mask in zip(flows, better, better[::-1], masks, strict=True):
            sure = np.where(mask, forward_backward_confidence(found, back), flow.confidence)
            scene.write_flow(Flow(flow.i, flow.j, found, sure))
    scene.amend_prior("flow", objects=True)


Pair = tuple[np.ndarray, np.ndarray]
"""Of one frame and of another one, or from the one to the other and back."""


def _search(images: Pair, masks: Pair, flows: Pair) -> Pair:
    """Return both flows [H, W, 2], those of objects the better of what is there and of what is found where nothing else is seen."""
    rows, columns = (np.flatnonzero((masks[0] | masks[1]).any(axis)) for axis in (1, 0))
    top, left = max(rows[0] - SEARCH_MARGIN, 0), max(columns[0] - SEARCH_MARGIN, 0)
    box = slice(top, rows[-1] + 1 + SEARCH_MARGIN), slice(left, columns[-1] + 1 + SEARCH_MARGIN)
    a, b = (np.where(mask, gray(image), REST_GRAY).astype(np.uint8)[box] for image, mask in zip(images, masks, strict=True))
    # The same box in both frames, so that flows need no shift.
    there = [flow[box] for flow in flows]
    found = [dis_flow(a, b, fine=True), dis_flow(b, a, fine=True)]
    shown, inside = [image[box].astype(np.float32) for image in images], [mask[box].astype(np.float32) for mask in masks]
    result = []
    for n, m in ((0, 1), (1, 0)):
        costs = [_cost(shown[n], shown[m], inside[n], inside[m], each[n], each[m]) for each in (there, found)]
        take = (inside[n] > 0) & (costs[1] < costs[0])
        merged = flows[n].copy()
        merged[box] = np.where(take[..., None], found[n], there[n])
        result.append(merged)
    return result[0], result[1]


def _cost(a: np.ndarray, b: np.ndarray, mask_a: np.ndarray, mask_b: np.ndarray, flow: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return [H, W] what speaks against a flow from ``a`` to ``b`` around each pixel of an object, in gray levels."""
    unlike = np.minimum(np.abs(a - _warp(b, flow)).mean(-1), MAX_COLOR_DIFFERENCE)
    misses = lengths(flow + _warp(back, flow)) / (0.5 + 0.05 * lengths(flow))
    cost = unlike + OUTSIDE_COST * (1 - _warp(mask_b, flow)) + ROUND_TRIP_DIFFERENCE * np.minimum(misses, MAX_ROUND_TRIP_LIMITS)
    return np.asarray(
        cv2.GaussianBlur(cost * mask_a, (0, 0), WINDOW_SIGMA) / np.maximum(cv2.GaussianBlur(mask_a, (0, 0), WINDOW_SIGMA), 1e-3)
    )


def _warp(values: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Return the map [H, W, ...] whose pixel p is that at p + flow(p)."""
    x, y = np.moveaxis(pixel_grid(*flow.shape[1::-1]) + flow - 0.5, -1, 0).astype(np.float32)
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
