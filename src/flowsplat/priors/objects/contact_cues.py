"""Derive cues for an object's distance from contact with the ground: that it stands there, or that it touched it for moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from flowsplat.priors.objects.contact import Bound
from flowsplat.priors.objects.distance import Cue

CONTACT_SIGMA, CONTACT_ERROR_RATE = 0.06, 0.2
"""Standard deviation of ln distance that contact with the ground has at least, most likely for 17 objects of worlds below 900 and
rendered scenes (docs/notebook/2026-11.md, "Masks of what moves"), and the chance that it has nothing to do with the truth: of 17
such objects with own priors 4 were more than .15 off (docs/notebook/2026-11.md, "Contact, counted")."""
BOUNCE_ERROR_RATE = 0.1
"""Chance that a bounce has nothing to do with the truth. Chosen by eye."""
MAX_BOUND_RANGE, BOUND_LOW_PERCENTILE, BOUND_HIGH_PERCENTILE = 0.1, 10, 70
"""Range of the bounds between two percentiles over time up to which an object stands on the ground. Chosen on random worlds of
seeds 0 to 14 (docs/notebook/2026-11.md)."""
MAX_UNEVEN_RANGE, UNEVEN_ERROR_RATE = 0.4, 0.35
"""Range up to which it may stand there though its bounds change: with the pose of who dances, with a foot that a shadow hides
(docs/notebook/2026-11.md, "Contact, counted"). And the chance that it does not: of 13 such objects 5 were more than .15 off."""
MIN_FEET_SHARE = 0.5
"""Share of the frames in which an object is seen in which its feet must be seen, too: what swings hides where it is high. Chosen
on random worlds of seeds 0 to 14 (docs/notebook/2026-11.md)."""
MIN_BOUNDS = 8
"""Frames with a bound below which an object is not said to stand. Chosen by eye."""
MAX_BOUND_STEP = 0.15
"""Change of a bound from one frame to the next, in ln, from which the two are of different things: of an object and its shadow, of
two objects that share a number. Nobody walks or bounces that fast. Counted on twelve crowds of seeds 100 to 111, where .15 and .25
keep nearly the same frames (docs/notebook/2026-11.md, "Bounds that jump")."""
STEP_FRAMES = 5.0
"""Frames: standard deviation over time of what feet say about a depth trajectory; steps are shorter. Chosen by eye."""
SUPPOSED_SIGMA, SUPPOSED_ERROR_RATE = 0.06, 0.5
"""What is added to the error of a contact with ground that was not seen, by eye, and its chance to be wrong: of ten such objects
six were more than .15 off (docs/notebook/2026-11.md, "Contact, counted"), of five before it .4 was most likely."""
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
        lowest_log_depth: [T] likewise, if its lowest pixels were right below its middle.
        visible: [T] bool: its lowest pixels are seen.
        ground_seen: [T] bool: the ground is seen there, and not only supposed to go on.
        frames: in how many frames the object is seen.
    """

    bounds: Sequence[Bound | None]
    log_depth: np.ndarray
    lowest_log_depth: np.ndarray
    visible: np.ndarray
    ground_seen: np.ndarray
    frames: int

    @classmethod
    def of(cls, bounds: Sequence[Bound | None], frames: int) -> Feet:
        """Return those of an object that is seen in so many ``frames``."""
        return cls(
            bounds,
            np.array([np.nan if bound is None else bound.log_depth for bound in bounds]),
            np.array([np.nan if bound is None else bound.lowest_log_depth for bound in bounds]),
            np.array([bound is not None and bound.visible for bound in bounds]),
            np.array([bound is not None and bound.seen for bound in bounds]),
            frames,
        )

    def unevenness(self, depth_trajectory: np.ndarray) -> float:
        """Return how much its height above the ground would change over time by a depth trajectory [T], but for jumps: see
        ``unevenness``."""
        bounds = self.log_depth - depth_trajectory
        return unevenness(bounds, self.visible & ~find_jumps(bounds, self.visible, self.frames), self.frames)

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


def find_jumps(bounds: np.ndarray, visible: np.ndarray, frames: int) -> np.ndarray:
    """Return [T] bool: frames whose bound jumps away from that of most frames.

    Between two jumps is a run of frames. The longest one tells, and all whose median is about the same.

    Args:
        bounds: [T] of an object; ``visible`` [T]: whether its feet are.
        frames: in how many it is seen. Where too few would be left to say that it stands, none is said to jump.
    """
    result = np.zeros(len(bounds), bool)
    seen = np.flatnonzero(visible & np.isfinite(bounds))
    if len(seen) == 0:
        return result
    runs = np.split(seen, np.flatnonzero(np.abs(np.diff(bounds[seen])) > MAX_BOUND_STEP) + 1)
    level = np.median(bounds[max(runs, key=len)])
    for run in runs:
        result[run] = abs(np.median(bounds[run]) - level) > MAX_BOUND_RANGE
    if len(seen) - result.sum() < max(MIN_BOUNDS, MIN_FEET_SHARE * frames):
        result[:] = False
    return result


def contact_cue(bounds: np.ndarray, visible: np.ndarray, frames: int, most: float = MAX_UNEVEN_RANGE) -> Cue | None:
    """That an object stands on the ground: its bounds [T] change little over time.

    Args:
        visible: [T] whether its feet are.
        frames: in how many it is seen.
        most: its bounds may change by.

    Returns:
        None where its feet are seen in too few frames, or its height above the ground changes by more than whose outline and pose
        only change.
    """
    change = unevenness(bounds, visible, frames)
    if change > most:
        return None
    low, middle, high = np.percentile(bounds[visible & np.isfinite(bounds)], [BOUND_LOW_PERCENTILE, 35, BOUND_HIGH_PERCENTILE])
    wrong = CONTACT_ERROR_RATE if change <= MAX_BOUND_RANGE else UNEVEN_ERROR_RATE
    return Cue(float(middle), float(np.hypot(CONTACT_SIGMA, min(0.5 * (high - low), MAX_BOUND_RANGE))), wrong)


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
    return Cue(cue.log_scale, float(np.hypot(cue.sigma, SUPPOSED_SIGMA)), SUPPOSED_ERROR_RATE)


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
    return Cue(min(levels), THROWN_SIGMA if len(levels) > 1 else 1.5 * THROWN_SIGMA, BOUNCE_ERROR_RATE)


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
