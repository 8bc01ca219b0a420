"""Structure from motion in the frame of one rigid moving object, with known focal length.

A rigid object that moves before a camera is a still object before a camera of its own. Its points S and that camera's
poses (Q_t, tau_t) follow from the tracks on it, up to one scale: pixel = pi(Q_t S + tau_t). Bundle adjustment with the
points eliminated (Schur complement), grown frame by frame from the one with the most long tracks, with a Cauchy cost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flowsplat.priors.objects.rigid_equations import (
    move_points,
    reduce_system,
    refine_pose,
    robust_cost,
    second_differences,
    solve_band,
    turn,
    unpack_band,
    widest_link,
)

RESIDUAL_SCALE = 1.0
"""Pixels: an observation this far off has half its weight (Cauchy). Chosen by eye."""
SHAPE_RIDGE = 0.05
"""Precision of the prior that an object is no deeper than it is wide, in units of 1 / its width^2. Chosen by eye."""
POSE_SMOOTHNESS = 20.0
"""Precision of the prior that its pose changes evenly from frame to frame: it carries over frames with few tracks. Chosen by eye.
"""
TRACKS_PER_FRAME = 45
"""The longest tracks are taken until this many are seen in every frame. Chosen by eye."""
MIN_SHARED_POINTS = 6
"""Known points that a frame must see to be added. Chosen by eye."""
MIN_POINT_DEPTH = 0.05
"""Depth, in units of the object's mean distance, below which a point is taken for this near. Chosen by eye."""
INLIER_PIXELS = 1.5
"""Pixels up to which an observation agrees with the solution (docs/method/objects.md)."""

_GROW_ITERATIONS, _FINAL_ITERATIONS, _POSE_ITERATIONS = 4, 30, 8
"""Iterations of an adjustment while the solution grows, of the last one, and of the pose of one frame, at most. Chosen by eye."""
_ADJUST_EVERY, _ADJUST_SHARE = 4, 0.1
"""While it grows, a solution is adjusted, all of it each time, when it has so many more frames; beyond 80 of them, when it has this
share of them more, less ``_ADJUST_EVERY`` (docs/method/objects.md)."""
_DAMPING_TRIES = 5
"""How often a step that raises the cost is tried again with more damping. Chosen by eye."""
_MAX_TRACK_FRAMES, _PIECE_FRAMES, _TRACK_CUT_STAGGER = 100, 40, 23
"""Frames over which a track counts as one point, and those of a piece of a longer one: one that lasts for all of a long clip would
join all of its poses, and time grow with the cube of their number. By how many frames later the next one is cut
(docs/method/objects.md)."""


@dataclass(frozen=True)
class TrackObservations:
    """Where the points of one object were seen, sorted by point.

    Attributes:
        first: [N + 1] int64, observations first[n] to first[n + 1] are those of point n.
        frame_of: [M] int64 position of the frame.
        x: [M, 2] float64 (pixel - principal point) / focal length.
        frames: how many frames the clip has.
        focal: pixels.
    """

    first: np.ndarray
    frame_of: np.ndarray
    x: np.ndarray
    frames: int
    focal: float

    @property
    def points(self) -> int:
        """How many points there are."""
        return len(self.first) - 1

    @property
    def point_of(self) -> np.ndarray:
        """[M] the point of every observation."""
        return np.repeat(np.arange(self.points), np.diff(self.first))

    @staticmethod
    def of_tracks(positions: np.ndarray, seen: np.ndarray, K: np.ndarray) -> TrackObservations:
        """From tracks: positions [N, T, 2] in pixels, and where they count, seen [N, T]."""
        point, frame = map(np.ascontiguousarray, np.nonzero(seen))
        first = np.searchsorted(point, np.arange(len(seen) + 1))
        x = (positions[point, frame].astype(np.float64) - K[:2, 2]) / [K[0, 0], K[1, 1]]
        return TrackObservations(first, frame, np.ascontiguousarray(x), seen.shape[1], float(K[0, 0]))

    def in_pieces(self) -> TrackObservations:
        """Return the same, with points that were seen over more than ``_MAX_TRACK_FRAMES`` frames as several of ``_PIECE_FRAMES``.

        Each is cut at frames of its own: poses on either side of a cut are known relative to each other by all others.
        """
        point = self.point_of
        since = self.frame_of - self.frame_of[self.first[point]]
        long = np.zeros(self.points, bool)
        long[point[since >= _MAX_TRACK_FRAMES]] = True
        piece = np.where(long[point], (since + _TRACK_CUT_STAGGER * point % _PIECE_FRAMES) // _PIECE_FRAMES, 0)
        starts = np.flatnonzero(np.diff(self.point_of, prepend=-1) | np.diff(piece, prepend=0))
        return replace(self, first=np.append(starts, len(self.x)))


@dataclass(frozen=True)
class RigidSolution:
    """Poses of the camera in the object's frame, and the object's points; the mean logarithm of the depth of its origin is 0.

    Attributes:
        turns: [T, 3, 3] Q_t.
        shifts: [T, 3] tau_t.
        points: [N, 3] S.
        used: [T] bool, frames with a pose.
        known: [N] bool, points with a position.
        size: half the width of the object in units of the focal length, in the frame where it was started.
        cost: of the adjustment, pixels^2.
        observations: what it explains.
    """

    turns: np.ndarray
    shifts: np.ndarray
    points: np.ndarray
    used: np.ndarray
    known: np.ndarray
    size: float
    cost: float
    observations: TrackObservations

    def residuals(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for every observation the pixels that it is off, its depth in the object's unit, and whether it is explained at
        all [M]."""
        o, point = self.observations, self.observations.point_of
        y = np.einsum("mij,mj->mi", self.turns[o.frame_of], self.points[point]) + self.shifts[o.frame_of]
        off = o.focal * np.linalg.norm(y[:, :2] / np.maximum(y[:, 2:], MIN_POINT_DEPTH) - o.x, axis=1)
        return off, y[:, 2], self.used[o.frame_of] & self.known[point]

    @property
    def noise(self) -> float:
        """Robust standard deviation of an observation, pixels."""
        off, _, explained = self.residuals()
        return max(1.2 * float(np.median(off[explained])), 0.15) if explained.any() else np.inf

    @property
    def inliers(self) -> float:
        """Share of the explained observations that agree."""
        off, _, explained = self.residuals()
        return float((off[explained] < INLIER_PIXELS).mean()) if explained.any() else 0.0

    def log_depths(self) -> np.ndarray:
        """Return [T] median logarithm of the depth of the agreeing observations of each frame; NaN where fewer than three agree."""
        off, depth, explained = self.residuals()
        good = explained & (off < INLIER_PIXELS) & (depth > MIN_POINT_DEPTH)
        result = np.full(self.observations.frames, np.nan)
        for t in np.flatnonzero(self.used):
            here = good & (self.observations.frame_of == t)
            if here.sum() >= 3:
                result[t] = np.median(np.log(depth[here]))
        return result

    def widest_turn(self) -> float:
        """Degrees between the two orientations, relative to the camera, that differ most."""
        return widest_turn(self.turns[self.used])


def widest_turn(turns: np.ndarray) -> float:
    """Degrees between the two rotations of [F, 3, 3] that differ most; 0 of fewer than two."""
    if len(turns) < 2:
        return 0.0
    cosines = (np.einsum("aij,bij->ab", turns, turns) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosines.min(), -1, 1))))


def pose_information(motion: RigidSolution) -> tuple[np.ndarray, np.ndarray]:
    """Used frames [F], and the information [6F, 6F] on their poses (turn, shift) for a noise of one pixel, points eliminated."""
    o, frames = motion.observations, np.flatnonzero(motion.used)
    place = np.full(o.frames, -1)
    place[frames] = np.arange(len(frames))
    turns, shifts = motion.turns[frames], motion.shifts[frames]
    prior = _unevenness(turns, shifts)[0]
    H = reduce_system(
        turns, shifts, motion.points, o.first, place[o.frame_of], o.x, motion.known, o.focal, RESIDUAL_SCALE,
        SHAPE_RIDGE / motion.size**2, 0.0, widest_link(o.first, place[o.frame_of], motion.known),
    )[0]  # fmt: skip
    H[:, : prior.shape[1]] += prior
    return frames, unpack_band(H)


def longest(seen: np.ndarray, most: int = TRACKS_PER_FRAME) -> np.ndarray:
    """Return indices of the longest of the tracks seen [N, T], until nearly every frame of theirs has ``most``."""
    have, kept = np.zeros(seen.shape[1], int), []
    for n in np.argsort(-seen.sum(1), kind="stable"):
        if seen[n].any() and (have[seen[n]] < most).mean() > 0.3:
            kept.append(n)
            have[seen[n]] += 1
    return np.sort(np.array(kept, int))


def solve_rigid(observations: TrackObservations) -> RigidSolution | None:
    """Return the motion of a rigid object from its tracks, and the better of it and its mirror image (Necker's ambiguity).

    Returns:
        None where no frame sees enough points.
    """
    solver = _Solver(observations)
    if not solver.begin():
        return None
    solver.grow()
    solver.adjust(_FINAL_ITERATIONS, 1e-4)
    plain, mirrored = solver.result(), solver.mirror()
    mirrored.adjust(_FINAL_ITERATIONS, 1e-4)
    other = mirrored.result()
    return other if other.cost < plain.cost else plain


def refine_rigid(motion: RigidSolution, observations: TrackObservations, points: np.ndarray) -> RigidSolution:
    """Return a motion that is known roughly, from other observations of the same object and their rough points [N, 3]."""
    solver = _Solver(observations)
    solver.resume(motion, points)
    solver.adjust(_FINAL_ITERATIONS, 1e-4)
    return solver.result()


class _Solver:
    def __init__(self, observations: TrackObservations):
        self._o = o = observations
        self._turns, self._shifts = np.tile(np.eye(3), (o.frames, 1, 1)), np.zeros((o.frames, 3))
        self._points = np.zeros((o.points, 3))
        self._used, self._known = np.zeros(o.frames, bool), np.zeros(o.points, bool)
        self._size, self._cost, self._reference = 0.1, np.inf, 0
        self._point_of = o.point_of
        self._rows = [np.flatnonzero(o.frame_of == t) for t in range(o.frames)]

    def resume(self, motion: RigidSolution, points: np.ndarray) -> None:
        """The poses of a motion that was found before, in the frames that still see enough points."""
        o = self._o
        self._known = np.isfinite(points).all(1)
        counts = np.bincount(o.frame_of[self._known[self._point_of]], minlength=o.frames)
        self._used = motion.used & (counts >= MIN_SHARED_POINTS)
        self._turns, self._shifts = motion.turns.copy(), motion.shifts.copy()
        self._points = np.where(self._known[:, None], points, 0)
        self._size, self._reference = motion.size, int(counts.argmax())

    def begin(self) -> bool:
        """Return a flat billboard in the frame with the most long tracks; False where no frame sees enough of them."""
        o = self._o
        lengths = np.minimum(np.diff(o.first), 40).astype(float)
        self._reference = int(np.bincount(o.frame_of, lengths[self._point_of], o.frames).argmax()) if len(o.x) else 0
        rows = self._rows[self._reference]
        if len(rows) < MIN_SHARED_POINTS:
            return False
        middle = np.median(o.x[rows], 0)
        self._size = max(float(np.std(o.x[rows], axis=0).max()), 1e-3)
        self._shifts[self._reference], self._used[self._reference] = [*middle, 1.0], True
        self._points[self._point_of[rows], :2] = o.x[rows] - middle
        self._known[self._point_of[rows]] = True
        return True

    def grow(self) -> None:
        """Add frame after frame outwards: its pose from known points, then the points that are new in it."""
        o, adjusted = self._o, 1
        for t in sorted(set(range(o.frames)) - {self._reference}, key=lambda t: abs(t - self._reference)):
            rows = self._rows[t]
            known = self._known[self._point_of[rows]]
            old, new = rows[known], rows[~known]
            if len(old) < MIN_SHARED_POINTS:
                continue
            near = np.flatnonzero(self._used)
            self._place(t, int(near[np.abs(near - t).argmin()]), old)
            rays = np.concatenate([o.x[new], np.ones((len(new), 1))], 1)
            self._points[self._point_of[new]] = (rays * self._shifts[t, 2] - self._shifts[t]) @ self._turns[t]
            self._known[self._point_of[new]] = True
            used = int(self._used.sum())
            if used - adjusted >= max(_ADJUST_EVERY, _ADJUST_SHARE * used - _ADJUST_EVERY):
                self.adjust(_GROW_ITERATIONS, 1e-3)
                adjusted = used

    def _place(self, t: int, near: int, rows: np.ndarray) -> None:
        """The pose of frame t, begun from that of frame ``near`` by how the points grew and shifted."""
        o, points = self._o, self._points[self._point_of[rows]]
        y = points @ self._turns[near].T + self._shifts[near]
        before, now = y[:, :2] / np.maximum(y[:, 2:], MIN_POINT_DEPTH), o.x[rows]
        z = self._shifts[near, 2] / np.clip(_radius(now) / _radius(before), 0.7, 1.4)
        middle = self._shifts[near, :2] / self._shifts[near, 2] + np.median(now - before, 0)
        shift = np.array([*(middle * z), z])
        self._turns[t], self._shifts[t] = refine_pose(
            self._turns[near].copy(), shift, points, np.ascontiguousarray(now), o.focal, RESIDUAL_SCALE, _POSE_ITERATIONS
        )
        self._used[t] = True

    def adjust(self, iterations: int, tolerance: float) -> None:
        """Levenberg-Marquardt over used frames and known points."""
        o, frames = self._o, np.flatnonzero(self._used)
        place = np.full(o.frames, -1)
        place[frames] = np.arange(len(frames))
        turns, shifts, points = self._turns[frames], self._shifts[frames], self._points
        ridge = SHAPE_RIDGE / self._size**2
        fixed = o.first, place[o.frame_of], o.x, self._known, o.focal, RESIDUAL_SCALE, ridge
        reach = widest_link(o.first, place[o.frame_of], self._known)
        damping, cost = 1e-3, robust_cost(turns, shifts, points, *fixed) + _unevenness(turns, shifts)[2]
        for _ in range(iterations):
            prior, pull, _ = _unevenness(turns, shifts)
            after = np.inf
            for _ in range(_DAMPING_TRIES):
                H, b, own, inverses, gradients, links = reduce_system(turns, shifts, points, *fixed, damping, reach)
                H[:, : prior.shape[1]] += prior
                H[:, 0] += damping * (own + prior[:, 0]) + 1e-9
                step = solve_band(H, b + pull)
                moved = move_points(points, step, o.first, fixed[1], inverses, gradients, links, self._known)
                new_turns = turn(turns, step)
                new_shifts = shifts + step.reshape(-1, 6)[:, 3:]
                after = robust_cost(new_turns, new_shifts, moved, *fixed) + _unevenness(new_turns, new_shifts)[2]
                if after < cost:
                    turns, shifts, points = new_turns, new_shifts, moved
                    damping = max(damping / 5, 1e-7)
                    break
                damping *= 5
            done = not cost - after > tolerance * cost
            cost = min(cost, after)
            if done:
                break
        middle = np.median(points[self._known], 0)
        shifts = shifts + turns @ middle
        scale = np.exp(np.mean(np.log(np.maximum(shifts[:, 2], MIN_POINT_DEPTH))))
        self._turns[frames], self._shifts[frames] = turns, shifts / scale
        self._points = np.where(self._known[:, None], (points - middle) / scale, 0)
        self._cost = cost

    def mirror(self) -> _Solver:
        """Return the same with mirrored shape offset and mirrored turns, which looks almost the same."""
        other = _Solver(self._o)
        other._used, other._known, other._size = self._used.copy(), self._known.copy(), self._size
        other._reference, other._shifts = self._reference, self._shifts.copy()
        flip, start = np.diag([1.0, 1, -1]), self._turns[self._reference]
        other._points = self._points @ start.T @ flip @ start
        other._turns = flip @ (self._turns @ start.T) @ flip @ start
        return other

    def result(self) -> RigidSolution:
        return RigidSolution(
            self._turns, self._shifts, self._points, self._used, self._known, self._size, float(self._cost), self._o
        )


def _radius(x: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(x - np.median(x, 0), axis=1))) + 1e-6


def _unevenness(turns: np.ndarray, shifts: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Prior of even motion as normal equations, a band [6F, 13] and [6F], and cost: second differences, weighed
    ``POSE_SMOOTHNESS``."""
    return second_differences(turns, shifts, POSE_SMOOTHNESS)
