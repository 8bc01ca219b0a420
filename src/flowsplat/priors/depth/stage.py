"""The depth stage: planar depth for every training frame, without learned weights (METHOD 9)."""

from __future__ import annotations

import numpy as np

from flowsplat.common.progress import track
from flowsplat.priors.background.fill import upsample
from flowsplat.priors.background.longflow import STRIDES
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.static_depth import StaticDepth, camera_reach, static_depth
from flowsplat.priors.depth.movers import MARGIN, card, growth, smooth_cards
from flowsplat.priors.flow import FlowEstimator, dis_estimator
from flowsplat.scenes import Depth, Scene

NEAREST_DEPTH, FURTHEST_DEPTH = 0.05, 30.0
"""Multiples of the median depth between which all depths lie."""

MOVER_CONFIDENCE = 0.6
MOSTLY = 0.6
"""Share of trusted pixels from which depth is called known."""
TRUSTED_WEIGHT = 5.0
"""Weight at which a static pixel has a confidence of one half."""


def depth_stage(scene: Scene, estimate: FlowEstimator = dis_estimator) -> None:
    """Depth with confidence for every training frame that has none. Needs cameras and flow, and uses masks if there are any.

    Static pixels come from their matches in other frames of the same piece of the clip, movers are cards in front of what
    they hide. A clip whose camera does not move (or only turns) gets a guess, and the verdict says so.

    Args:
        estimate: finds the flow between frames that are no neighbours.
    """
    clip = MatchedClip(scene, estimate)
    has_masks = all(scene.has_mask(i) for i in scene.train_frames)
    background = static_depth(clip, has_masks)
    cards = _cards(clip, background) if has_masks else {}
    trusted = []
    for k, i in enumerate(track(scene.train_frames, "Depth")):
        if not scene.has_depth(i):
            scene.write_depth(i, _frame_depth(clip, background, cards, k))
        trusted.append(float(scene.depth(i).trusted.mean()))
    method, share = ("multi-view" if clip.has_parallax else "guess"), float(np.mean(trusted))
    if clip.has_parallax:
        verdict = f"{share:.0%} of the pixels trusted"
        if share < MOSTLY:
            verdict += ": the rest is filled in, and new views from aside will show it"
    else:
        travels = camera_reach(clip) > 1e-9
        little = f"travels too little within {STRIDES[-1]} frames" if travels else "does not travel"
        verdict = f"the camera {little}, so depth is a guess: new views from aside will be wrong"
        if travels and len(clip) > 2 * STRIDES[-1]:
            verdict += "; --every takes frames further apart, which may show it"
    scene.finish_prior(
        "depth", method=method, verdict=verdict, trusted=round(share, 4),
        parallax=round(clip.mean_parallax, 3), objects=len(cards),
    )  # fmt: skip


def _cards(clip: MatchedClip, background: StaticDepth) -> dict[int, np.ndarray]:
    """Smoothed inverse depth [T] of every object over the training frames."""
    cards: dict[int, np.ndarray] = {}
    growths: dict[int, np.ndarray] = {}
    ahead: dict[int, float] = {}
    for k in track(range(len(clip)), "Depth of movers"):
        mask = clip.mask(k)
        if not mask.any():
            ahead = {}
            continue
        front, back, before = background.foremost(k), _growths(clip, k, k - 1, mask), ahead
        ahead = _growths(clip, k, k + 1, mask)
        for number in map(int, np.unique(mask[mask > 0])):
            cards.setdefault(number, np.full(len(clip), np.nan))[k] = card(mask == number, front)
            both = growths.setdefault(number, np.zeros(len(clip)))
            if number in before and number in back:
                both[k] = (before[number] - back[number]) / 2
    pieces = np.asarray(clip.continuity.pieces)
    return {number: smooth_cards(values, growths[number], pieces) for number, values in cards.items()}


def _growths(clip: MatchedClip, k: int, j: int, mask: np.ndarray) -> dict[int, float]:
    """Logarithm of how much larger the objects of training frame ``k`` are in its neighbour ``j``."""
    if not 0 <= j < len(clip) or not clip.continuity.joined(k, j):
        return {}
    flow, confidence = clip.step_flow(k, j)
    return {int(number): growth(mask == number, flow, confidence) for number in np.unique(mask[mask > 0])}


def _frame_depth(clip: MatchedClip, background: StaticDepth, cards: dict[int, np.ndarray], k: int) -> Depth:
    scene = clip.scene
    frame = scene.frame(scene.train_frames[k])
    inverse, weight = background.filled(k)
    mask = scene.mask(scene.train_frames[k]) if cards else np.zeros((scene.height, scene.width), np.uint8)
    size = (scene.width, scene.height)
    moving = mask > 0
    if moving.any():
        plate = background.plate(k)
        inverse = np.where(clip.mask(k) > 0, plate, inverse)
        static = upsample(inverse, frame, *size)
        front = upsample(background.foremost(k), np.zeros_like(frame), *size)
        heights = np.array([cards[n][k] if n in cards else np.nan for n in range(int(mask.max()) + 1)], np.float32)
        # An object too small to be seen at working resolution has no card and stays just in front of what is known to be behind it.
        nearness = np.nan_to_num(heights)[mask]
        static = np.where(moving, np.maximum(nearness, MARGIN * front), static)
    else:
        static = upsample(inverse, frame, *size)
    limits = background.median / FURTHEST_DEPTH, background.median / NEAREST_DEPTH
    depth = 1 / np.clip(static, *limits)
    large_weight = np.maximum(upsample(weight.astype(np.float32), np.zeros_like(frame), *size), 0)
    confidence = np.where(moving, MOVER_CONFIDENCE, large_weight / (large_weight + TRUSTED_WEIGHT))
    return Depth(depth.astype(np.float32), confidence.astype(np.float32))
