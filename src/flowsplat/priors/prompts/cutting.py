"""An object cut out on the frame on which it was shown: by what moves where that is sure, by its colors where it is not."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from flowsplat.images.edge_smoothing import EdgeSmoother
from flowsplat.priors.masks.colors import ColorModel, look_up
from flowsplat.priors.prompts.grabcut import GRABCUT_ROUNDS, grab, keep_touched, snap_to_edges
from flowsplat.priors.prompts.parsing import CLICK_RADIUS, Point, Prompt
from flowsplat.scenes import Flow

SEARCH_REACH = 0.25
"""Share of the image's long side within which the object under a click is looked for. Chosen by eye."""

MENDING_REACH = 0.08
"""The same of what a click adds to an object that was carried, or takes from it (docs/method/masks.md)."""

MIN_OWN_MOTION = 1.0
"""Pixels a frame by which an object's motion must differ from its surroundings' to be told by it. Chosen by eye."""

MIN_CUT_SHARE = 0.2
"""Share of a first guess below which what GrabCut leaves of it is a failure. Chosen by eye."""

SURROUNDINGS_SIDES = 0.5
"""Sides of a box within which what is round it tells how what is behind it moves. Chosen by eye."""

MIN_FLOW_NOISE, MOTION_NOISE_RATIO = 0.15, 2.5
"""Least noise of the flow around in pixels, and multiples of it at which a motion is evidence of neither (docs/method/masks.md)."""

MAX_FIT_PIXELS, MIN_FIT_PIXELS = 4000, 50
"""Pixels that it is fitted to at most, and at least. Chosen by eye."""

EVIDENCE_WEIGHT, MAX_EVIDENCE, SURE_EVIDENCE = 0.5, 3.0, 1.5
"""Weight of what all frames say, the most that evidence counts (a logarithm to base 2), and what is sure of it. The first was
chosen on tuned scenes and random worlds (docs/method/masks.md; docs/notebook/2026-11.md, Clicks and boxes)."""

MIN_MOVING_SHARE = 0.08
"""Share of a box that must surely move for evidence to decide in it (docs/method/masks.md)."""

COLOR_WEIGHT, MAX_COLOR_EVIDENCE = 0.7, 1.5
"""Weight of the colors' logarithm to base 2, and the most that it counts. Chosen by eye."""

_COLOR_ROUNDS = 3
"""How often the colors are taken anew (docs/method/masks.md)."""
EDGE_AWARE_SMOOTHNESS, COLOR_SIGMA = 20.0, 10.0
"""Of the smoother along the edges of the image, and gray levels across which it no longer reaches. Chosen by eye."""


def cut_out(image: np.ndarray, flow: Flow, prompt: Prompt, evidence: np.ndarray | None = None) -> np.ndarray:
    """Return the object of a prompt, bool [H, W]; what is beside it changes nothing where it is no part of it anyway.

    Args:
        image: RGB [H, W, 3] uint8.
        flow: to a near frame.
        evidence: [H, W] float32, a logarithm to base 2, positive where something moves; None = what the flow says.
    """
    if prompt.beside:
        alone = _cut(image, flow, replace(prompt, beside=()), evidence)
        prompt = replace(prompt, beside=list_excluded(prompt, alone))
        if not prompt.beside:
            return alone
    return _cut(image, flow, prompt, evidence)


def list_excluded(prompt: Prompt, found: np.ndarray) -> tuple[Point, ...]:
    """Return those places that are said to be beside an object which touch what was found of it, bool [H, W]."""
    return tuple(place for place in prompt.beside if (_disc([place], found.shape) & found).any())


def _cut(image: np.ndarray, flow: Flow, prompt: Prompt, evidence: np.ndarray | None) -> np.ndarray:
    """As ``cut_out``, away from all that is said to be beside."""
    seeds, beside, possible = _places(prompt, flow.confidence.shape)
    bits = _unlike_around(flow, seeds, possible, prompt) if evidence is None else np.float32(EVIDENCE_WEIGHT) * evidence
    bits = cv2.medianBlur(np.clip(bits, -MAX_EVIDENCE, MAX_EVIDENCE).astype(np.float32), 5)
    chosen = _choose_evidence(bits, prompt, seeds, possible)
    if chosen is None:
        found = _by_colors(image, flow.flow, prompt, seeds, beside, possible)
    else:
        found = _by_evidence(image, np.where(possible, chosen, -MAX_EVIDENCE), seeds, beside, possible)
    found &= ~beside
    return keep_touched(found, seeds) if prompt.clicks else found


def correct(image: np.ndarray, flow: Flow, prompt: Prompt, carried: np.ndarray, evidence: np.ndarray | None = None) -> np.ndarray:
    """Return an object that was carried to a frame, bool [H, W], with clicks on what it misses and beside it.

    Args:
        image: RGB [H, W, 3] uint8.
        flow: to a near frame.
        prompt: without a box.
        carried: bool [H, W].
        evidence: as for ``cut_out``.
    """
    shape = carried.shape
    seeds, beside, _ = _places(prompt, shape)
    guess = carried.copy()
    for click in prompt.clicks:
        if not carried[_pixel(click, shape)]:
            near = _disc([click], shape, MENDING_REACH * max(shape))
            added = cut_out(image, flow, Prompt(prompt.frame, (click,), None, prompt.beside), evidence)
            guess |= added & near if (carried & near).any() else added
    for click in prompt.beside:
        if guess[_pixel(click, shape)]:
            spot = _disc([click], shape)
            near = _disc([click], shape, MENDING_REACH * max(shape)) & guess
            guess &= ~(_like_the_click(image, flow.flow, spot, near) & near)
    guess = (guess | seeds) & ~beside
    trimap = np.full(shape, cv2.GC_BGD, np.uint8)
    trimap[cv2.dilate(guess.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0] = cv2.GC_PR_BGD
    trimap[guess] = cv2.GC_PR_FGD
    trimap[cv2.erode(guess.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0] = cv2.GC_FGD
    trimap[seeds], trimap[beside] = cv2.GC_FGD, cv2.GC_BGD
    return grab(image, trimap, 1)


def _pixel(point: Point, shape: tuple[int, ...]) -> tuple[int, int]:
    """Row and column."""
    return min(int(point[1]), shape[0] - 1), min(int(point[0]), shape[1] - 1)


def _disc(points: list[Point], shape: tuple[int, ...], radius: float = 0.0) -> np.ndarray:
    """Discs bool [H, W] round points, of the size of a click where no radius is given."""
    drawn = np.zeros(shape, np.uint8)
    for point in points:
        row, column = _pixel(point, shape)
        cv2.circle(drawn, (column, row), round(radius) or max(2, round(CLICK_RADIUS * max(shape))), 1, -1)
    return drawn > 0


def _places(prompt: Prompt, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bool [H, W]: what is clicked, what is clicked as beside it, and where the object may be."""
    seeds, beside = _disc(list(prompt.clicks), shape), _disc(list(prompt.beside), shape)
    if prompt.box is None:
        possible = _disc(list(prompt.clicks), shape, SEARCH_REACH * max(shape))
    else:
        x0, y0, x1, y1 = (round(value) for value in prompt.box)
        possible = np.zeros(shape, bool)
        possible[y0:y1, x0:x1] = True
    return seeds & ~beside, beside, possible


def _unlike_around(flow: Flow, seeds: np.ndarray, possible: np.ndarray, prompt: Prompt) -> np.ndarray:
    """Return evidence [H, W] of one flow: how much the motion differs from that around, which is affine there, over its noise.

    Without a box, how much more it is like that of the click.
    """
    if prompt.box is None:
        ring = _disc(list(prompt.clicks), possible.shape, 2 * SEARCH_REACH * max(possible.shape))
    else:
        x, y, w, h = cv2.boundingRect(possible.astype(np.uint8))
        margin = max(8, round(SURROUNDINGS_SIDES * max(w, h)))
        ring = np.zeros_like(possible)
        ring[max(y - margin, 0) : y + h + margin, max(x - margin, 0) : x + w + margin] = True
        ring &= ~possible
        if ring.sum() < MIN_FIT_PIXELS:
            ring[:] = True
    apart, noise = _apart_from(flow, ring)
    if prompt.box is not None:
        return np.log2(np.maximum(apart, 1e-3) / (MOTION_NOISE_RATIO * noise))
    if np.median(apart[seeds]) < MOTION_NOISE_RATIO * noise:
        return np.full(possible.shape, -1.0)
    own = np.linalg.norm(flow.flow - np.median(flow.flow[seeds], axis=0), axis=-1)
    return np.log2((apart + noise) / (own + noise))


def _apart_from(flow: Flow, ring: np.ndarray) -> tuple[np.ndarray, float]:
    """Return pixels [H, W] by which a flow differs from what is affine and fits most of ``ring``, and by which it differs there."""
    height, width = ring.shape
    rows, columns = np.nonzero(ring)
    every = max(1, len(rows) // MAX_FIT_PIXELS)
    rows, columns = rows[::every], columns[::every]
    x, y = np.meshgrid((np.arange(width) - width / 2) / width, (np.arange(height) - height / 2) / width)
    terms = np.stack([np.ones_like(x), x, y], -1)
    A, moved = terms[rows, columns], flow.flow[rows, columns].astype(float)
    weights = flow.confidence[rows, columns].astype(float) + 1e-3
    apart = np.linalg.norm(moved - np.median(moved, axis=0), axis=1)
    for _ in range(8):
        scale = 2 * max(1.4826 * float(np.median(apart)), 0.05)
        root = np.sqrt(weights / (1 + (apart / scale) ** 2))[:, None]
        solved = np.linalg.lstsq(A * root, moved * root, rcond=None)[0]
        apart = np.linalg.norm(moved - A @ solved, axis=1)
    return np.linalg.norm(flow.flow - terms @ solved, axis=-1), max(float(np.median(apart)), MIN_FLOW_NOISE)


def _choose_evidence(bits: np.ndarray, prompt: Prompt, seeds: np.ndarray, possible: np.ndarray) -> np.ndarray | None:
    """Return evidence [H, W] of the object alone, without what else moves; None where it does not tell."""
    count, labels = cv2.connectedComponents((bits > 0).astype(np.uint8))
    if prompt.box is None:
        if np.median(bits[seeds]) <= 0:
            return None
        own = np.isin(np.arange(count), labels[seeds])
        own[0] = False
        return np.where(own[labels], bits, np.minimum(bits, -1))
    if ((bits > SURE_EVIDENCE) & possible).sum() < MIN_MOVING_SHARE * possible.sum():
        return None
    within, total = (np.bincount(labels[where], minlength=count) for where in (possible, np.ones_like(possible)))
    # What reaches far out of the box is something else.
    others = within < 0.5 * total
    others[0] = False
    if within[1:][~others[1:]].sum() < 0.05 * possible.sum():
        others[:] = False
    return np.where(others[labels], -MAX_EVIDENCE, bits)


def _by_evidence(image: np.ndarray, bits: np.ndarray, seeds: np.ndarray, beside: np.ndarray, possible: np.ndarray) -> np.ndarray:
    """Return evidence and colors, which are learned from it, added up and smoothed along the edges of the image: bool [H, W]."""
    smoother = EdgeSmoother(image, EDGE_AWARE_SMOOTHNESS, COLOR_SIGMA)
    bits = bits.astype(np.float32)
    bits[seeds], bits[beside] = 2 * MAX_EVIDENCE, -2 * MAX_EVIDENCE
    total = smoother.filter(bits)
    for _ in range(_COLOR_ROUNDS):
        colors = ColorModel()
        colors.add(image, possible & (total > 0) & ~beside)
        table = colors.table()
        if table is None:
            break
        like = np.float32(COLOR_WEIGHT) * np.clip(look_up(table, image), -MAX_COLOR_EVIDENCE, MAX_COLOR_EVIDENCE)
        total = smoother.filter(np.where(possible, bits + like, -2 * MAX_EVIDENCE).astype(np.float32))
    found = possible & (total > 0)
    return snap_to_edges(image, found) if found.any() else seeds.copy()


def _by_colors(
    image: np.ndarray, flow: np.ndarray, prompt: Prompt, seeds: np.ndarray, beside: np.ndarray, possible: np.ndarray
) -> np.ndarray:
    """GrabCut from the box, or from what looks or moves like the click, bool [H, W]."""
    # The colors of a box decide best; where they fail, its motion does.
    guesses = [_like_the_click(image, flow, seeds, possible)] if prompt.box is None else [possible, _unlike_outside(flow, possible)]
    for guess in guesses:
        trimap = np.full(possible.shape, cv2.GC_BGD, np.uint8)
        trimap[possible] = cv2.GC_PR_BGD
        trimap[guess] = cv2.GC_PR_FGD
        trimap[seeds], trimap[beside] = cv2.GC_FGD, cv2.GC_BGD
        found = grab(image, trimap, GRABCUT_ROUNDS)
        found = keep_touched(found, seeds) if prompt.clicks else found
        if found.sum() > MIN_CUT_SHARE * guess.sum():
            return found
    return guesses[-1] | seeds


def _unlike_outside(flow: np.ndarray, possible: np.ndarray) -> np.ndarray:
    """Return what of a box, bool [H, W], does not move as its surroundings do; all of it where nothing does."""
    ring = cv2.dilate(possible.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    around = flow[ring & ~possible]
    if len(around) == 0:
        return possible
    moves = possible & (np.linalg.norm(flow - np.median(around, axis=0), axis=-1) > 0.5 * MIN_OWN_MOTION)
    return moves if moves.sum() > MIN_CUT_SHARE * possible.sum() else possible


def _like_the_click(image: np.ndarray, flow: np.ndarray, seeds: np.ndarray, possible: np.ndarray) -> np.ndarray:
    """Return what near a click, bool [H, W], moves as it does; where nothing moves apart, what looks like it."""
    own = np.median(flow[seeds], axis=0)
    apart = float(np.linalg.norm(own - np.median(flow[possible], axis=0)))
    if apart > MIN_OWN_MOTION:
        moves = keep_touched(possible & (np.linalg.norm(flow - own, axis=-1) < 0.5 * apart), seeds)
        if moves.sum() > 4 * seeds.sum():
            return moves
    lab = cv2.cvtColor(cv2.bilateralFilter(np.ascontiguousarray(image), 7, 30, 5), cv2.COLOR_RGB2LAB).astype(np.float32)
    color = np.median(lab[seeds], axis=0)
    distance = np.linalg.norm(lab - color, axis=-1)
    return keep_touched(possible & (distance < 12 + 2 * float(np.median(distance[seeds]))), seeds)
