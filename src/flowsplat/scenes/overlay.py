"""What is burnt into a clip and stays on the screen while the camera moves: a logo, a clock, a watermark.

Its edges stay in place to a fraction of a pixel in all frames, those beside it do not. Where the camera stands still all edges
stay, and nothing can be told; an edge that runs along the motion stays, too, so edges of two directions are asked for.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from flowsplat.geometry.cameras import pixel_grid

COMPARED_FRAMES = 24
"""Frames that are compared. Chosen by eye."""
MIN_FRAMES = 8
"""Frames without which nothing is said: edges that change at random then still share .35 of their length. Chosen by eye."""
MIN_EDGE, MIN_FIXED_EDGE = 6.0, 8.0
"""Gray levels a pixel: of the mean length of a gradient that counts, and of the length of the mean gradient that stays. Chosen by
eye."""
FIXED_SHARE, SURE_SHARE = 0.9, 0.95
"""Length of the mean gradient over the mean length, of edges that stay: of those that are looked at, and of those that are part of
what was found. Chosen by eye."""
MAX_STILL_SHARE = 0.5
"""The same over all edges, in the median, above which the clip does not move enough to tell. It is .23 to .30 on the clips of DAVIS
and the rig scenes, .3 to 1 on random worlds."""
JOIN_SHARE = 0.02
"""Share of the longer side within which edges that stay are one thing, and within which those beside it lie. Chosen by eye."""
MIN_EDGE_PIXELS = 40
"""Pixels of edges that stay in one thing. Chosen by eye."""
MIN_CROSS_EDGES = 0.12
"""Least strength of edges in one direction, over that in the other: logos and clocks have .3 or more, horizons and rails .05 or
less."""
MAX_DRIFT = 0.3
"""Pixels by which a thing is away from its mean place at most, in any frame. Of what is burnt in it is at most .2; of what else in
six clips of DAVIS, four rig scenes and 56 random worlds passes the other bounds, at least .43."""
MIN_BESIDE, MAX_BESIDE_SHARE, STAYING = 0.05, 0.15, 0.8
"""Of what lies beside it, the share of pixels with edges at least, and the share of these edges at most that stay with so much of
their length. Chosen by eye."""
MAX_AREA_SHARE = 0.2
"""Share of the image that one thing may cover. Chosen by eye."""
LETTER_GAP, MAX_LETTER_DRIFT = 6, 0.6
"""Halves of ``JOIN_SHARE`` within which something belongs to a thing that tells, and pixels by which it may drift: what shows
through half-transparent letters makes more of a difference to a few of them. Chosen by eye."""
RIM_PIXELS = 2
"""Pixels by which what was found is widened: half-transparent rims, and what coding smears. Chosen by eye."""

FILL_RADIUS = 3
"""Pixels round a filled pixel that its color comes from. Chosen by eye."""


def find_overlay(images: Iterable[np.ndarray]) -> np.ndarray | None:
    """Return [H, W] bool where something is burnt in; None where nothing is found.

    Args:
        images: RGB [H, W, 3] uint8, ``COMPARED_FRAMES`` of them or fewer, spread over the clip.
    """
    grays = np.array([cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 0.8) for image in images])
    if len(grays) < MIN_FRAMES:
        return None
    along, down, length = _mean_gradients(grays)
    share = np.hypot(along, down) / np.maximum(length, 1e-6)
    edges = length > MIN_EDGE
    fixed = edges & (share > FIXED_SHARE) & (np.hypot(along, down) > MIN_FIXED_EDGE)
    others = edges & ~fixed
    if fixed.sum() < MIN_EDGE_PIXELS or not others.any() or np.median(share[others]) > MAX_STILL_SHARE:
        return None
    reach = max(2, round(JOIN_SHARE * max(fixed.shape) / 2))
    found, small = np.zeros((2, *fixed.shape), np.uint8)  # things that tell, and what may be a letter beside one
    _, numbers, boxes, _ = cv2.connectedComponentsWithStats(_widen(fixed, reach))
    for number, (left, top, width, height, _) in list(enumerate(boxes))[1:]:
        around = slice(max(0, top - reach), top + height + reach), slice(max(0, left - reach), left + width + reach)
        thing = fixed[around] & (numbers[around] == number)
        beside = _widen(thing, 2 * reach).astype(bool) & ~_widen(thing, RIM_PIXELS).astype(bool)
        drift, crosses = _measure_drift(grays[(slice(None), *around)], along[around], down[around], thing)
        if (
            drift <= MAX_LETTER_DRIFT
            and width * height <= MAX_AREA_SHARE * fixed.size
            and _moves(share[around], others[around], beside)
        ):
            tells = drift <= MAX_DRIFT and thing.sum() >= MIN_EDGE_PIXELS and crosses >= MIN_CROSS_EDGES
            (found if tells else small)[around] |= _fill(thing & (share[around] > SURE_SHARE), reach)
    if not found.any():
        return None
    _, numbers = cv2.connectedComponents(found | small)
    near = np.unique(numbers[(_widen(found, LETTER_GAP * reach) > 0) & (small > 0)])
    return (found > 0) | np.isin(numbers, near[near > 0])


def _mean_gradients(grays: np.ndarray) -> np.ndarray:
    """Return [3, H, W]: the mean gradient along x and along y, and its mean length, in gray levels a pixel."""
    total = np.zeros((3, *grays.shape[1:]), np.float32)
    for gray in grays:
        gradient = [cv2.Scharr(gray, cv2.CV_32F, *axis, scale=1 / 16) for axis in ((1, 0), (0, 1))]
        for k, plane in enumerate((*gradient, cv2.magnitude(*gradient))):
            total[k] += plane
    return total / len(grays)


def _widen(mask: np.ndarray, pixels: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * pixels + 1,) * 2, np.uint8))


def _moves(share: np.ndarray, others: np.ndarray, beside: np.ndarray) -> bool:
    """Return whether the edges beside a thing do not stay."""
    seen = others & beside
    return bool(seen.sum() >= MIN_BESIDE * beside.sum() and (share[seen] > STAYING).mean() <= MAX_BESIDE_SHARE)


def _measure_drift(grays: np.ndarray, along: np.ndarray, down: np.ndarray, thing: np.ndarray) -> tuple[float, float]:
    """Return by how many pixels the edges of a thing shift at most in a frame, and how strong they are across over along it.

    The shift is what explains the difference from the mean image best, to first order; edges of one direction tell it across them.
    """
    gradient = np.stack([along[thing], down[thing]], 1).astype(np.float64)
    normal = gradient.T @ gradient
    weaker, stronger = np.linalg.eigvalsh(normal)
    levels = grays[:, thing].astype(np.float64)
    shifts = np.linalg.pinv(normal, rcond=MIN_CROSS_EDGES, hermitian=True) @ gradient.T @ (levels - levels.mean(0)).T
    return float(np.abs(shifts).max()), float(weaker / max(stronger, 1e-9))


def _fill(edges: np.ndarray, reach: int) -> np.ndarray:
    """Return [H, W] uint8: edges with what they enclose, and gaps between them."""
    closed = cv2.erode(_widen(edges, reach), np.ones((2 * reach + 1,) * 2, np.uint8))
    outlines, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return _widen(cv2.drawContours(closed, outlines, -1, 1, cv2.FILLED), RIM_PIXELS)


def fill_overlay(image: np.ndarray, overlay: np.ndarray) -> np.ndarray:
    """Return RGB [H, W, 3] uint8 with what is burnt in [H, W] bool filled from around it: the same whatever was there.

    Telea 2004 (https://doi.org/10.1080/10867651.2004.10487596).
    """
    blank = np.where(overlay[..., None], np.uint8(0), image)
    return np.asarray(cv2.inpaint(blank, overlay.astype(np.uint8), FILL_RADIUS, cv2.INPAINT_TELEA))


def look_up_mask(mask: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return [...] bool: whether points [..., 2] in pixels lie in a mask [H, W] bool; False outside of it and where not finite."""
    height, width = mask.shape
    inside = (points >= 0).all(-1) & (points[..., 0] < width) & (points[..., 1] < height)
    x, y = np.moveaxis(np.where(inside[..., None], points, 0).astype(np.int64), -1, 0)
    return inside & mask[y, x]


def hide_overlay(overlay: np.ndarray | None, flow: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Return the confidence [H, W] of flow [H, W, 2] without what begins or ends on what is burnt in.

    Args:
        overlay: bool [H, W] or of another size, or None.
    """
    if overlay is None:
        return confidence
    height, width = confidence.shape
    if overlay.shape != confidence.shape:
        overlay = cv2.resize(overlay.astype(np.uint8), (width, height), interpolation=cv2.INTER_AREA) > 0
    return np.where(overlay | look_up_mask(overlay, pixel_grid(width, height) + flow), 0, confidence)
