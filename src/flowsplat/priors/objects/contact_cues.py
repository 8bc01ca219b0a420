"""Derive cues for an object's distance from contact with the ground: that it stands there, or that it touched it for moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from flowsplat.priors.objects.contact import Bound
from flowsplat.priors.objects.distance import Cue

MIN_CUE_SIGMA = {"contact": 0.025, "bounce": 0.03}
"""Standard deviation of ln distance that each has at least."""
CUE_ERROR_RATE = {"contact": 0.07, "bounce": 0.1}
"""Chance that it has nothing to do with the truth."""
MAX_BOUND_RANGE, BOUND_LOW_PERCENTILE, BOUND_HIGH_PERCENTILE = 0.1, 10, 70
"""Range of the bounds between two percentiles over time up to which an object stands on the ground. Chosen on random worlds of
seeds 0 to 14 (docs/results.md)."""
MIN_FEET_SHARE = 0.5
"""Share of the frames in which an object is seen in which its feet must be seen, too: what swings hides where it is high. Chosen
on random worlds of seeds 0 to 14 (docs/results.md)."""
MIN_BOUNDS = 8
"""Frames with a bound below which an object is not said to stand. Chosen by eye."""
STEP_FRAMES = 5.0
"""Frames: standard deviation over time of what feet say about a depth trajectory; steps are shorter. Chosen by eye."""
SUPPOSED_SIGMA, SUPPOSED_WRONG_CHANCE = 0.06, 0.25
"""What is added to the error of a contact with ground that was not seen, and its chance to be wrong. Chosen by eye."""
BOUNCE_SPAN = 2
"""Frames to either side over which the second difference of the bounds is taken. Chosen by eye."""
MIN_BOUNCE, MIN_BOUNCE_NOISES = 0.1, 4.0
"""Second difference of the bounds from which a minimum may be a bounce, and how many times their usual spread that must be.
Chosen by eye."""
BOUNCE_WIDTH, MAX_BOUNCE_ELSEWHERE = 4, 0.25
"""So many frames from a bounce the second difference is at most this share of that at it: a smooth minimum is wider.
Chosen by eye."""
THROWN_SIGMA = 0.03
"""Standard deviation of the nearest bound at several bounces; of a single one it is half as much more. Chosen by eye."""
FOOT_REACH = 0.15
"""Standard deviation of the distance, in the image, at which points of an object tell of its foot: of the root of its area.
Chosen by eye."""


@dataclass(frozen=True)
class Feet:
    """Where an object would touch the ground in the T frames of a clip.

    Attributes:
        bounds: [T] what each frame says of it.
        log_depth: [T] logarithm of the depth of the object's middle there; NaN where a frame says nothing.
        visible: [T] bool: its lowest pixels are seen.
        ground_seen: [T] bool: the ground is seen there, and not only supposed to go on.
        frames: in how many frames the object is seen.
    """

    bounds: Sequence[Bound | None]
    log_depth: np.ndarray
    visible: np.ndarray
    ground_seen: np.ndarray
    frames: int

    @classmethod
    def of(cls, bounds: Sequence[Bound | None], frames: int) -> Feet:
        """Return those of an object that is seen in so many ``frames``."""
        return cls(
            bounds,
            np.array([np.nan if bound is None else bound.log_depth for bound in bounds]),
            np.array([bound is not None and bound.visible for bound in bounds]),
            np.array([bound is not None and bound.seen for bound in bounds]),
            frames,
        )

    def unevenness(self, depth_trajectory: np.ndarray) -> float:
        """Return how much its height above the ground would change over time by a depth trajectory [T]: see ``unevenness``."""
        return unevenness(self.log_depth - depth_trajectory, self.visible, self.frames)

    def is_supposed(self, depth_trajectory: np.ndarray) -> bool:
        """Return whether the ground under a depth trajectory [T] is supposed rather than seen."""
        known = np.isfinite(self.log_depth - depth_trajectory)
        return bool(known.any()) and float(self.ground_seen[known].mean()) < 0.5


def unevenness(bounds: np.ndarray, visible: np.ndarray, frames: int) -> float:
    """Return how much the bounds [T] of an object change over time; inf where its feet are seen in too few of the ``frames``."""
    seen = bounds[visible & np.isfinite(bounds)]
    if len(seen) < max(MIN_BOUNDS, MIN_FEET_SHARE * frames):
        return np.inf
    low, high = np.percentile(seen, [BOUND_LOW_PERCENTILE, BOUND_HIGH_PERCENTILE])
    return float(high - low)


def contact_cue(bounds: np.ndarray, visible: np.ndarray, frames: int) -> Cue | None:
    """That an object stands on the ground: its bounds [T] hardly change over time.

    Args:
        visible: [T] whether its feet are.
        frames: in how many it is seen.
    """
    if unevenness(bounds, visible, frames) > MAX_BOUND_RANGE:
        return None
    low, middle, high = np.percentile(bounds[visible & np.isfinite(bounds)], [BOUND_LOW_PERCENTILE, 35, BOUND_HIGH_PERCENTILE])
    return Cue(float(middle), float(np.hypot(MIN_CUE_SIGMA["contact"], 0.5 * (high - low))), CUE_ERROR_RATE["contact"])


def settle_on_ground(above: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return [T] what brings the depth trajectory of an object that stands to the ground over time.

    A depth trajectory that only its size tells is some percent off over time, where feet are seen to one or two.

    Args:
        above: [T] in ln, how much farther than its depth trajectory each frame's feet would be on the ground.
        visible: [T] whether they are seen.
    """
    seen = visible & np.isfinite(above)
    weight = gaussian_filter1d(seen.astype(float), STEP_FRAMES, mode="nearest")
    value = gaussian_filter1d(np.where(seen, np.clip(above, -MAX_BOUND_RANGE, MAX_BOUND_RANGE), 0), STEP_FRAMES, mode="nearest")
    return np.where(weight > 1e-3, value / np.maximum(weight, 1e-3), 0)


def unsurer(cue: Cue) -> Cue:
    """Return the same on ground that was not seen."""
    return Cue(cue.log_scale, float(np.hypot(cue.sigma, SUPPOSED_SIGMA)), SUPPOSED_WRONG_CHANCE)


def make_thrown_cue(bounds: np.ndarray, thrown: np.ndarray) -> Cue | None:
    """That an object touched the ground in the frames in which its own path was thrown up.

    Thin tips of a mask and feet that something hides put a bound too far, so the nearest of them speaks.

    Args:
        bounds: [T] at its lowest pixels (``foot_offset``), NaN where they are not seen.
        thrown: [B] frames.
    """
    levels = [float(np.nanmin(around)) for k in thrown if np.isfinite(around := bounds[max(k - 1, 0) : k + 2]).any()]
    if not levels:
        return None
    return Cue(min(levels), THROWN_SIGMA if len(levels) > 1 else 1.5 * THROWN_SIGMA, CUE_ERROR_RATE["bounce"])


def foot_offset(lowest: np.ndarray, front: np.ndarray, pixels: np.ndarray, offsets: np.ndarray, sigma: np.ndarray) -> float:
    """By how much, in ln, the lowest pixels of an object are farther than its upright billboard in one frame.

    They lie on its rim, where a round body is farther than its front; its points correct that.

    Args:
        lowest: [n, 2] int (column, row).
        front: ``roundness`` [H, W] of its mask.
        pixels: [N, 2] of points that stand out of billboard and front by offsets [N], with standard deviation sigma [N].
    """
    rim = float(np.median(front[lowest[:, 1], lowest[:, 0]]))
    reach = max(6.0, FOOT_REACH * float(np.sqrt((front != 0).sum())))
    near = np.exp(-0.5 * ((pixels - lowest.mean(0) - 0.5) ** 2).sum(1) / reach**2)
    if near.sum() <= 1:
        return rim
    weight = near / (sigma**2 + 0.01**2)
    return rim + float((weight * offsets).sum() / weight.sum())


def bounce_cue(bounds: np.ndarray) -> Cue | None:
    """That an object touched the ground for moments: its bounds [T] have sharp minima, where it bounced.

    Between bounces what is thrown falls towards the ground ever faster, so the bounds are concave there. What swings or flies
    past has a smooth minimum.
    """
    n, levels = BOUNCE_SPAN, []
    curved = np.full(len(bounds), np.nan)
    curved[n:-n] = bounds[2 * n :] - 2 * bounds[n:-n] + bounds[: -2 * n]
    known = curved[np.isfinite(curved)]
    if len(known) < MIN_BOUNDS:
        return None
    least = max(MIN_BOUNCE, MIN_BOUNCE_NOISES * 1.5 * float(np.median(np.abs(known - np.median(known)))))
    for k in range(2 * n, len(bounds) - 2 * n):
        around = curved[max(k - BOUNCE_WIDTH, 0) : k + BOUNCE_WIDTH + 1]
        if not (np.isfinite(curved[k - n : k + n + 1]).all() and curved[k] >= least and curved[k] >= np.nanmax(around)):
            continue
        beyond = np.array([curved[j] for j in (k - BOUNCE_WIDTH, k + BOUNCE_WIDTH) if 0 <= j < len(curved)])
        if np.isfinite(beyond).any() and np.nanmax(beyond) <= MAX_BOUNCE_ELSEWHERE * curved[k]:
            # It touched between two frames: where the lines through both flanks meet.
            left, right = bounds[k - 1] - bounds[k - 2], bounds[k + 2] - bounds[k + 1]
            if left < 0 < right:
                meet = np.clip((bounds[k + 1] - right - bounds[k - 1] - left) / (left - right), -1, 1)
                level = min(bounds[k - 1] + left * (meet + 1), float(bounds[k - 1 : k + 2].min()))
                levels.append(max(level, float(bounds[k - 1 : k + 2].min()) - 0.05))
    if not levels:
        return None
    middle, spread = float(np.median(levels)), float(np.ptp(levels))
    if spread > MAX_BOUND_RANGE:
        return None  # It is the same ground each time.
    few = len(levels) == 1
    return Cue(
        middle, float(np.hypot(0.05 if few else MIN_CUE_SIGMA["bounce"], 0.5 * spread)), 0.2 if few else CUE_ERROR_RATE["bounce"]
    )
