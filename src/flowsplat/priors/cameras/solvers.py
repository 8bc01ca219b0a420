"""Choose among the cameras of several solvers: judged by tracks that no adjustment has seen, and by whether the path is sane.

That all frames were placed proves nothing: a wrong focal length and a collapsed path place them, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.priors.cameras.checks import LARGE_ERROR, MIN_STATIC_SHARE
from flowsplat.priors.cameras.estimate import CameraEstimate, estimate, estimate_static
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.pieces import MIN_TRACKS
from flowsplat.priors.cameras.refinement import best_tracks, robust_errors, with_points
from flowsplat.priors.cameras.selection import mostly_on_rim

JUDGE_STRIDE = 8
"""Every how many of the longer tracks one is kept from the adjustments (docs/method/cameras.md)."""
MIN_JUDGE_VIEWS = 3
"""Frames that such a track was seen in: every second one places its point, the others judge it. Chosen by eye."""
MIN_JUDGES = 30
"""Such tracks below which they cannot be spared. Chosen by eye."""
MAX_TURN_JUMP = 3.0
"""Degrees by which the turn from frame to frame may change at once, in any clip. Chosen by eye."""
MAX_JUMP_RATIO = 8.0
"""Times the usual change of a turn, or of a step, that count as a jump. Chosen by eye."""
MAX_STEP_JUMP = 0.03
"""Change of a step, in median distances of the points, that is never a jump. Chosen by eye."""
MIN_PATH_EXTENT = 1e-4
"""Extent of the path, in median distances of the points, below which a moving camera does not move. Chosen by eye."""
FIELD_OF_VIEW = (8.0, 130.0)
"""Degrees across that cameras have. Chosen by eye."""
MAX_COST_RATIO = 0.9
"""The second solver is taken where its cost is below this share of the first one's, or where only it is sane
(docs/method/cameras.md)."""


@dataclass(frozen=True)
class Judgment:
    """What speaks for and against the cameras of one solver.

    Attributes:
        solver: its name.
        pixels: median error of kept-back static tracks in the frames that did not place their points; None where there
            are too few such tracks.
        cost: the mean robust cost of the same observations, without unit; 0 where there are too few.
        jumps: frames of the clip before which the path jumps.
        faults: what is impossible about the cameras, in words.
        poor: whether another solver is worth a try.
    """

    solver: str
    pixels: float | None
    cost: float
    jumps: list[int]
    faults: list[str]
    poor: bool

    @property
    def sane(self) -> bool:
        """Whether the cameras are possible."""
        return not (self.jumps or self.faults)

    def to_json(self, unit: float) -> dict[str, Any]:
        """Plain numbers, in pixels of the frames."""
        pixels = None if self.pixels is None else round(self.pixels * unit, 4)
        return {"solver": self.solver, "heldout_tracks_px": pixels, "jumps": self.jumps, "faults": self.faults}

    def describe_errors(self, unit: float) -> str:
        """ "misses kept-back tracks by 0.12 pixels and jumps before frame 7"."""
        words = [] if self.pixels is None else [f"misses kept-back tracks by {self.pixels * unit:.2f} pixels"]
        if self.jumps:
            words.append(f"jumps before frame {self.jumps[0]}")
        words += self.faults
        return " and ".join(words) or "places the frames"


@dataclass(frozen=True)
class Solved:
    """The cameras that were taken, and what was found about all that were tried, the taken ones first."""

    found: CameraEstimate
    judgments: list[Judgment]

    def reason(self, unit: float) -> str:
        """Why these were taken, in a sentence; empty where there was no choice.

        Args:
            unit: pixels of the frames in a pixel of the tracks.
        """
        if len(self.judgments) < 2:
            return ""
        taken, other = self.judgments
        return (
            f"Two solvers were tried, and the {taken.solver} one was taken: it {taken.describe_errors(unit)}, "
            f"the {other.solver} one {other.describe_errors(unit)}."
        )


def solve(
    seen: Observations, width: float, height: float, focal: float | None, solver: str, frames: Sequence[int] | None = None,
    still: bool = False,
) -> Solved:  # fmt: skip
    """Return cameras of one piece of a clip.

    Args:
        seen: the tracks, in pixels of the frames.
        focal: pixels, where it is known.
        solver: ``own`` (frame after frame), ``global`` (all at once), or ``auto``: the first, and where its cameras look
            bad the second, of which the better is taken.
        frames: their numbers in the clip, where some are left out.
        still: the images say that the camera stands still: no other is looked for.
    """
    used, judges = keep_back(seen)
    rim = judges.of_points(mostly_on_rim(judges, width, height))
    name = "own" if solver == "auto" else solver
    if still:
        standing = estimate_static(used, width, height, focal)
        return Solved(standing, [judge(name, standing, rim if standing.surrounds else judges, width, height, frames)])
    first = estimate(used, width, height, focal, name)
    judgment = judge(name, first, rim if first.surrounds else judges, width, height, frames)
    if solver != "auto" or not judgment.poor:
        return Solved(first, [judgment])
    second = estimate(used, width, height, focal, "global")
    # Where something in front fills the image, what is seen along the rim judges either.
    judges = rim if first.surrounds or second.surrounds else judges
    found = {name: judge(name, cameras, judges, width, height, frames) for name, cameras in (("own", first), ("global", second))}
    if prefer(found["global"], found["own"]):
        return Solved(second, [found["global"], found["own"]])
    return Solved(first, [found["own"], found["global"]])


def prefer(second: Judgment, first: Judgment) -> bool:
    """Return whether the second solver's cameras are to be taken."""
    if second.sane != first.sane:
        return second.sane
    return second.cost < MAX_COST_RATIO * first.cost


def keep_back(seen: Observations) -> tuple[Observations, Observations]:
    """Return the tracks to adjust to, and those that judge; none of these where tracks are few."""
    longer = np.flatnonzero(seen.counts >= MIN_JUDGE_VIEWS)
    kept = longer[JUDGE_STRIDE // 2 :: JUDGE_STRIDE]
    if len(kept) < MIN_JUDGES:
        kept = kept[:0]
    return seen.of_points(np.setdiff1d(np.arange(seen.points), kept)), seen.of_points(kept)


def judge(
    name: str, found: CameraEstimate, seen: Observations, width: float, height: float, frames: Sequence[int] | None = None
) -> Judgment:
    """Return what tracks that no adjustment has seen say about cameras, and whether the path is possible.

    A track's point is placed from every second frame that saw it and judged in the others.

    Args:
        seen: the kept-back tracks, in pixels of the frames.
        frames: their numbers in the clip, where some are left out.
    """
    pixels, cost = _heldout_errors(found, seen, width, height)
    jumps = find_jumps(found, frames) if found.motion in ("free", "rotation") else []
    jumps = jumps if frames is None else [int(frames[t]) for t in jumps]
    faults = _faults(found, width)
    lost = found.motion == "free" and (bool(found.unplaced) or found.fit.static.mean() < MIN_STATIC_SHARE)
    poor = bool(jumps or faults or lost or (pixels is not None and pixels > LARGE_ERROR))
    return Judgment(name, pixels, cost, jumps, faults, poor and found.motion != "unknown")


def _heldout_errors(found: CameraEstimate, seen: Observations, width: float, height: float) -> tuple[float | None, float]:
    """Return the median error in pixels of the observations that fit best, and their mean robust cost."""
    if seen.points < MIN_TRACKS:
        return None, 0.0
    centered = seen.from_middle(width, height)
    places = (np.arange(len(seen)) - seen.first[seen.point]) % 2 == 0
    state = with_points(found.fit.state, centered.where(places), free_translations=found.motion == "free")
    observed = centered.where(~places)
    error, cost = robust_errors(state, observed)
    best = best_tracks(np.bincount(observed.point, cost, observed.points), observed.counts)
    judged = np.isin(observed.point, best)
    if not judged.any():
        return None, 0.0
    return float(np.median(error[judged])), float(cost[judged].mean())


def find_jumps(found: CameraEstimate, frames: Sequence[int] | None = None) -> list[int]:
    """Return positions before which the path turns or leaps quite unlike anywhere else.

    Compared are the changes of speed from one step to the next: a pan may be fast, but it begins and ends.

    Args:
        frames: [T] their numbers in the clip, where some are left out.
    """
    state = found.fit.state
    count = len(state.rotations)
    if count < 5:
        return []
    gaps = np.diff(np.arange(count) if frames is None else np.asarray(frames))[:, None]
    turns = Rotation.from_matrix(state.rotations[1:] @ state.rotations[:-1].transpose(0, 2, 1)).as_rotvec() / gaps
    change = np.degrees(np.linalg.norm(np.diff(turns, axis=0), axis=1))
    jumps = change > max(MAX_TURN_JUMP, MAX_JUMP_RATIO * float(np.median(change)))
    if found.motion == "free":
        leaps = np.linalg.norm(np.diff(np.diff(state.centers, axis=0) / gaps, axis=0), axis=1) / _distance(found)
        jumps |= leaps > max(MAX_STEP_JUMP, MAX_JUMP_RATIO * float(np.median(leaps)))
    # One jump changes two steps: it is named once, before the frame that it leads to.
    places = np.flatnonzero(jumps) + 1
    return [int(t) for k, t in enumerate(places) if k == 0 or t > places[k - 1] + 1]


def _distance(found: CameraEstimate) -> float:
    """Return the median distance of the static points from the path."""
    state = found.fit.state
    static = state.points[found.fit.static] if len(state.points) == len(found.fit.static) else state.points
    if len(static) == 0:
        return 1.0
    return max(float(np.median(np.linalg.norm(static - state.centers.mean(0), axis=1))), 1e-12)


def _faults(found: CameraEstimate, width: float) -> list[str]:
    faults = []
    if found.motion in ("free", "rotation"):
        angle = float(2 * np.degrees(np.arctan(width / 2 / found.fit.state.focal)))
        if not FIELD_OF_VIEW[0] <= angle <= FIELD_OF_VIEW[1]:
            faults.append(f"sees {angle:.0f} degrees across")
    if found.motion == "free":
        extent = np.linalg.norm(np.ptp(found.fit.state.centers, axis=0)) / _distance(found)
        if extent < MIN_PATH_EXTENT:
            faults.append("hardly moves")
    return faults
