"""Depth of the static scene in every frame: weighed, fused with the neighbors, filled."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from flowsplat.common.spread import spread
from flowsplat.common.threads import compute_once
from flowsplat.geometry import Camera
from flowsplat.priors.background.fill import fill
from flowsplat.priors.background.fuse import fuse
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.reprojection import reproject, uncover

MIN_DEPTH, MAX_DEPTH = 0.05, 30.0
"""Multiples of the median depth between which all depths lie. Chosen by eye."""

FUSION_OFFSETS = (2, 4, 8, 16)
"""Training frames before and after, whose depth is fused with a frame's own. Chosen by eye."""

PLATE_OFFSETS = (2, 4, 8, 16, 24)
"""Training frames before and after, from which hidden background is taken. Chosen by eye."""

MAX_INVERSE_DEPTH, MIN_INVERSE_DEPTH = 20.0, 0.01
"""Inverse depths above the first multiple of the clip's median are mistakes; those below the second are as good as at it.
Chosen by eye."""

SURE_WEIGHT = 5.0
"""Weight from which a value speaks for pixels of other frames, and below which it gives way to theirs. Chosen by eye."""

GUESS_WEIGHT = 6.0
"""Weight of a guess: little more than what is trusted. Chosen by eye."""

_REJECTED_WEIGHT_FACTOR = 0.02
"""What remains of a weight that more neighbors contradict than confirm. Chosen by eye."""

_PLATE_SMOOTHNESS = 100.0
"""Of the smoother that fills the background behind objects, which follows no edges. Chosen by eye."""

_MIN_KNOWN_SHARE = 1e-3
"""Share of pixels with a known value, below which a frame's depth is guessed. Chosen by eye."""

CONFIRMING_FRAMES = 24
"""Frames, evenly over a piece of the clip, before whose static scene an object stands. The depth of frames far apart differs by
some percent, and where an object were behind what one of them saw, it would make that vanish (docs/method/depth.md)."""

_KEPT_FRAMES = 2 * PLATE_OFFSETS[-1] + 16 + CONFIRMING_FRAMES
"""Frames in memory: on a walk over the clip every one is asked for again until it lies behind the furthest neighbor."""


class StaticDepth(Protocol):
    """Depth of the static scene by position in the training frames, at working resolution."""

    median: float

    def plate(self, k: int) -> np.ndarray:
        """Return inverse depth [h, w] of the static scene, also behind objects, whose own edges play no part in it."""
        ...

    def compute_foremost(self, k: int) -> np.ndarray:
        """Return inverse depth [h, w] before which every object stands: the plate's, or what two other frames are sure of there."""
        ...

    def compute_confirmed(self, k: int) -> np.ndarray:
        """Return inverse depth [h, w] that two other frames are sure of, the second nearest; 0 where no two are."""
        ...

    def fill(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (inverse depth, weight) of the static scene, each [h, w]: along the image's edges where nothing is known."""
        ...

    def compute_uncovered(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (inverse depth, weight) of what the frame or others saw of the static scene, each [h, w]; weight 0 where none
        did."""
        ...

    def behind(self, k: int) -> np.ndarray:
        """Return inverse depth [h, w] of the static scene: the plate behind objects, elsewhere along the image's edges."""
        ...


def static_depth(clip: MatchedClip, has_masks: bool) -> StaticDepth:
    """From matches where the clip has parallax, else a guess."""
    return Background(clip, has_masks) if clip.has_parallax else Guess(clip)


class Guess:
    """A clip without parallax: a ground that comes nearer towards the bottom of the image."""

    def __init__(self, clip: MatchedClip):
        self.median = compute_far_inverse(clip)
        self._plate = guess_ground(clip.height, clip.width, self.median)

    def plate(self, k: int) -> np.ndarray:
        """As ``StaticDepth.plate``."""
        return self._plate

    def compute_foremost(self, k: int) -> np.ndarray:
        """As ``StaticDepth.compute_foremost``."""
        return self._plate

    def compute_confirmed(self, k: int) -> np.ndarray:
        """As ``StaticDepth.compute_confirmed``: nothing is sure."""
        return np.zeros_like(self._plate)

    def fill(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """As ``StaticDepth.fill``: a little trusted everywhere."""
        return self._plate, np.full_like(self._plate, GUESS_WEIGHT)

    def compute_uncovered(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """As ``StaticDepth.compute_uncovered``: nothing was seen."""
        return self._plate, np.zeros_like(self._plate)

    def behind(self, k: int) -> np.ndarray:
        """As ``StaticDepth.behind``."""
        return self._plate


def camera_reach(clip: MatchedClip) -> float:
    """Return how far the camera gets from where a piece of the clip begins."""
    centers, pieces = np.array([camera.center for camera in clip.cameras]), clip.continuity.pieces
    first = np.searchsorted(pieces, pieces)
    return float(np.linalg.norm(centers - centers[first], axis=1).max())


def compute_far_inverse(clip: MatchedClip) -> float:
    """Return inverse depth at which what little the cameras of a piece move shifts nothing by more than about a pixel; 1 at
    most."""
    return 1 / max(camera_reach(clip) * float(clip.cameras[0].K[0, 0]), 1.0)


class Background:
    """The static scene of a clip with parallax, by position in the training frames, at working resolution."""

    def __init__(self, clip: MatchedClip, has_masks: bool):
        self.median = clip.median
        self._clip, self._has_masks = clip, has_masks
        self._own = compute_once(self._weigh, 2 * FUSION_OFFSETS[-1] + 4)
        self._uncovered = compute_once(self._uncover, 8)
        # Objects are placed, and then drawn, on two walks over the clip.
        self._plates = compute_once(self._plate, len(clip))
        self._witnessed = compute_once(self._witness, len(clip))
        self._fused = compute_once(self._fuse, _KEPT_FRAMES)

    def mask(self, k: int) -> np.ndarray:
        """Object numbers [h, w]; all 0 where there are no masks yet."""
        if self._has_masks:
            return self._clip.mask(k)
        return np.zeros((self._clip.height, self._clip.width), np.uint8)

    def plate(self, k: int) -> np.ndarray:
        """As ``StaticDepth.plate``: known pixels, those of other frames too, and between them the smoothest surface."""
        return self._plates(k)

    def compute_foremost(self, k: int) -> np.ndarray:
        """As ``StaticDepth.compute_foremost``: the second nearest that frames from all over the piece are sure of."""
        return np.maximum(self.plate(k), self.compute_confirmed(k))

    def compute_confirmed(self, k: int) -> np.ndarray:
        """As ``StaticDepth.compute_confirmed``."""
        return self._witnessed(k)

    def _witness(self, k: int) -> np.ndarray:
        piece = [j for j in range(len(self._clip)) if self._clip.continuity.same_piece(k, j)]
        first, second = np.zeros((2, self._clip.height, self._clip.width), np.float32)
        for j in sorted({piece[n] for n in spread(len(piece), CONFIRMING_FRAMES)} - {k}):
            seen, _ = reproject(*self.sure(j), self._clip.cameras[k])
            first, second = np.maximum(first, seen), np.maximum(second, np.minimum(first, seen))
        return second

    def fill(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (inverse depth, weight) of the static scene, each [h, w]: along the image's edges where nothing is known."""
        values, weights = self._uncovered(k)
        if _is_unknown(weights):
            return guess_ground(self._clip.height, self._clip.width, self._clip.median), np.zeros_like(weights)
        inverse, support = fill(values, weights, self._clip.image(k))
        return inverse, weights + np.float32(0.1) * support

    def compute_uncovered(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """As ``StaticDepth.compute_uncovered``."""
        values, weights = self._uncovered(k)
        return values, np.where(weights > SURE_WEIGHT, weights, 0)

    def behind(self, k: int) -> np.ndarray:
        """Return inverse depth [h, w] of the static scene: the plate behind objects, elsewhere along the image's edges."""
        inverse, _ = self.fill(k)
        moving = self.mask(k) > 0
        return np.where(moving, self.plate(k), inverse) if moving.any() else inverse

    def _plate(self, k: int) -> np.ndarray:
        values, weights = self._uncovered(k)
        if _is_unknown(weights):
            return guess_ground(self._clip.height, self._clip.width, self._clip.median)
        return fill(values, weights, np.zeros((*values.shape, 3), np.uint8), _PLATE_SMOOTHNESS)[0]

    def _list_around(self, k: int, offsets: tuple[int, ...]) -> list[int]:
        around = [j for offset in offsets for j in (k - offset, k + offset) if 0 <= j < len(self._clip)]
        return [j for j in around if self._clip.continuity.same_piece(k, j)]

    def _uncover(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        values, weights, camera = self._fused(k)
        others = [self.sure(j) for j in self._list_around(k, PLATE_OFFSETS)]
        return uncover(_dilate_objects(self.mask(k)) | (weights < SURE_WEIGHT), values, weights, camera, others)

    def _weigh(self, k: int) -> tuple[np.ndarray, np.ndarray, Camera]:
        solution, median = self._clip[k], self._clip.median
        # Matches with hardly any parallax do not tell how far away a point is, but that it is far: the inverse of its depth is
        # known as well as that of any other. So what is far is weighed by the parallax that it would have at the median depth.
        inverse = np.maximum(solution.inverse_depth, MIN_INVERSE_DEPTH * median)
        information = solution.information * np.maximum(median / np.maximum(solution.inverse_depth, 1e-3 * median), 1) ** 2
        sane = (solution.information > 0) & (inverse < MAX_INVERSE_DEPTH * median) & (information > 1)
        weight = np.clip(information, 0, 400) / (1 + solution.motion**2)
        return inverse, np.where(sane & ~_dilate_objects(self.mask(k)), weight, 0).astype(np.float32), self._clip.cameras[k]

    def _fuse(self, k: int) -> tuple[np.ndarray, np.ndarray, Camera]:
        values, weights, camera = self._own(k)
        inverse, mass, votes = fuse(values, weights, camera, [self._own(j) for j in self._list_around(k, FUSION_OFFSETS)])
        mass = np.where(votes >= 0, mass, np.float32(_REJECTED_WEIGHT_FACTOR) * mass) * _away_from_edges(inverse, weights)
        return inverse, mass, camera

    def sure(self, k: int) -> tuple[np.ndarray, np.ndarray, Camera]:
        """Return inverse depth [h, w] of the static scene, its weight, 0 where it is not sure, and the camera of the frame."""
        values, weights, camera = self._fused(k)
        return values, np.where(weights > SURE_WEIGHT, weights, 0).astype(np.float32), camera

    def compute_sure_depth(self, k: int) -> np.ndarray:
        """Return planar depth [h, w] of the static scene where it is sure, not only that it is far; inf elsewhere."""
        inverse, weight, _ = self.sure(k)
        own = weight * np.minimum(inverse / self.median, 1) ** 2
        return np.where(own > SURE_WEIGHT, 1 / np.maximum(inverse, 1e-9), np.inf)


def guess_ground(height: int, width: int, median: float) -> np.ndarray:
    """Return inverse depth [h, w] float32 of a guess: a ground that comes nearer towards the bottom of the image."""
    rows = (np.arange(height, dtype=np.float32) + np.float32(0.5)) / np.float32(height)
    return np.repeat(((0.4 + 1.2 * rows) * median)[:, None], width, axis=1).astype(np.float32)


def _is_unknown(weights: np.ndarray) -> bool:
    return float((weights > 0).mean()) < _MIN_KNOWN_SHARE


def _dilate_objects(mask: np.ndarray) -> np.ndarray:
    """bool [h, w]: objects and what is so close that the flow search takes it along."""
    return cv2.dilate((mask > 0).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0


def _away_from_edges(inverse: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return [h, w] float32: near 0 where depth jumps within 3 pixels, because flow lets near surfaces swell; else near 1."""
    kernel = np.ones((7, 7), np.uint8)
    known = weights > 0
    high = cv2.dilate(np.where(known, inverse, 0).astype(np.float32), kernel)
    low = cv2.erode(np.where(known, inverse, np.inf).astype(np.float32), kernel)
    jump = np.zeros_like(inverse)
    jump[known] = np.minimum((high[known] - low[known]) / inverse[known], 10)
    return 1 / (1 + (jump / np.float32(0.1)) ** 4)
