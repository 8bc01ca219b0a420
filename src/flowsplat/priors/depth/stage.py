"""The depth stage: planar depth for every training frame, without learned weights (METHOD 4, 7)."""

from __future__ import annotations

import numpy as np

from flowsplat.common.progress import track
from flowsplat.priors.depth.background import Background, ground
from flowsplat.priors.depth.clip import SolvedClip
from flowsplat.priors.depth.fill import upsample
from flowsplat.priors.depth.longflow import STRIDES
from flowsplat.priors.depth.movers import MARGIN, card, smooth_cards
from flowsplat.scenes import Depth, Scene

NEAREST_DEPTH, FURTHEST_DEPTH = 0.05, 30.0
"""Multiples of the median depth between which all depths lie."""

GUESS_CONFIDENCE = 0.55
MOVER_CONFIDENCE = 0.6
MOSTLY = 0.6
"""Share of trusted pixels from which depth is called known."""
TRUSTED_WEIGHT = 5.0
"""Weight at which a static pixel has a confidence of one half."""


class _Guess:
    """A clip without parallax: a ground that comes nearer towards the bottom of the picture."""

    def __init__(self, clip: SolvedClip):
        self.median = 1 / max(_reach(clip) * float(clip.cameras[0].K[0, 0]), 1.0)
        self._plate = ground(clip.height, clip.width, self.median)

    def plate(self, k: int) -> np.ndarray:
        return self._plate

    def filled(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        weight = TRUSTED_WEIGHT * GUESS_CONFIDENCE / (1 - GUESS_CONFIDENCE)
        return self._plate, np.full_like(self._plate, weight)


def _reach(clip: SolvedClip) -> float:
    """How far the camera gets from where a piece of the clip begins.

    At this distance times the focal length what it moves shifts nothing by more than about a pixel.
    """
    centers, pieces = np.array([camera.center for camera in clip.cameras]), clip.continuity.pieces
    first = np.searchsorted(pieces, pieces)
    return float(np.linalg.norm(centers - centers[first], axis=1).max())


def depth_stage(scene: Scene) -> None:
    """Depth with confidence for every training frame that has none. Needs cameras and flow, and uses masks if there are any.

    Static pixels come from their matches in other frames of the same piece of the clip, movers are cards in front of what
    they hide. A clip whose camera does not move (or only turns) gets a guess, and the verdict says so.
    """
    clip = SolvedClip(scene)
    has_masks = all(scene.has_mask(i) for i in scene.train_frames)
    background = Background(clip, has_masks) if clip.has_parallax else _Guess(clip)
    median = clip.median if isinstance(background, Background) else background.median
    cards = _cards(clip, background) if has_masks else {}
    trusted = []
    for k, i in enumerate(track(scene.train_frames, "Depth")):
        if not scene.has_depth(i):
            scene.write_depth(i, _frame_depth(clip, background, cards, k, median))
        trusted.append(float(scene.depth(i).trusted.mean()))
    method, share = ("multi-view" if clip.has_parallax else "guess"), float(np.mean(trusted))
    if clip.has_parallax:
        verdict = f"{share:.0%} of the pixels trusted"
        if share < MOSTLY:
            verdict += ": the rest is filled in, and new views from aside will show it"
    else:
        travels = _reach(clip) > 1e-9
        little = f"travels too little within {STRIDES[-1]} frames" if travels else "does not travel"
        verdict = f"the camera {little}, so depth is a guess: new views from aside will be wrong"
        if travels and len(clip) > 2 * STRIDES[-1]:
            verdict += "; --every takes frames further apart, which may show it"
    scene.finish_prior(
        "depth", method=method, verdict=verdict, trusted=round(share, 4),
        parallax=round(clip.mean_parallax, 3), objects=len(cards),
    )  # fmt: skip


def _cards(clip: SolvedClip, background: Background | _Guess) -> dict[int, np.ndarray]:
    """Smoothed inverse depth [T] of every object over the training frames."""
    cards: dict[int, np.ndarray] = {}
    for k in track(range(len(clip)), "Depth of movers"):
        mask = clip.mask(k)
        objects = np.unique(mask[mask > 0])
        if len(objects):
            plate = background.plate(k)
            for number in objects:
                cards.setdefault(int(number), np.full(len(clip), np.nan))[k] = card(mask == number, plate)
    return {number: smooth_cards(values) for number, values in cards.items()}


def _frame_depth(clip: SolvedClip, background: Background | _Guess, cards: dict[int, np.ndarray], k: int, median: float) -> Depth:
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
        large_plate = upsample(plate, np.zeros_like(frame), *size)
        heights = np.array([cards[n][k] if n in cards else np.nan for n in range(int(mask.max()) + 1)], np.float32)
        # An object too small to be seen at working resolution has no card and stays just in front of its plate.
        nearness = np.nan_to_num(heights)[mask]
        static = np.where(moving, np.maximum(nearness, MARGIN * large_plate), static)
    else:
        static = upsample(inverse, frame, *size)
    limits = median / FURTHEST_DEPTH, median / NEAREST_DEPTH
    depth = 1 / np.clip(static, *limits)
    large_weight = np.maximum(upsample(weight.astype(np.float32), np.zeros_like(frame), *size), 0)
    confidence = np.where(moving, MOVER_CONFIDENCE, large_weight / (large_weight + TRUSTED_WEIGHT))
    return Depth(depth.astype(np.float32), confidence.astype(np.float32))
