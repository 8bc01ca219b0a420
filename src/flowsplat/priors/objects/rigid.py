"""Structure from motion in the frame of one rigid moving object, with known focal length.

A rigid object that moves before a camera is a still object before a camera of its own. Its points S and that camera's
poses (Q_t, tau_t) follow from the tracks on it, up to one scale: pixel = pi(Q_t S + tau_t). Bundle adjustment with the
points eliminated (Schur complement), grown frame by frame from the one with the most long tracks, with a Cauchy cost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.linalg import cho_factor, cho_solve, solveh_banded

RESIDUAL_WIDTH = 1.0
"""Pixels: an observation this far off has half its weight (Cauchy)."""
RELIEF_RIDGE = 0.05
"""Precision of the prior that an object is no deeper than it is wide, in units of 1 / its width^2."""
SMOOTHNESS = 20.0
"""Precision of the prior that its pose changes evenly from frame to frame: it carries over frames with few tracks."""
PER_FRAME = 45
"""The longest tracks are taken until this many are seen in every frame."""
FEWEST_SHARED = 6
"""Known points that a frame must see to be added."""
NEAREST = 0.05
"""Depth, in units of the object's mean distance, below which a point is taken for this near."""
INLIER = 1.5
"""Pixels up to which an observation agrees with the solution."""

_GROW_ITERATIONS, _FINAL_ITERATIONS, _POSE_ITERATIONS = 4, 30, 8
_ADJUST_EVERY, _ADJUST_SHARE = 4, 0.05
"""While it grows, a solution is adjusted when it has so many more frames, or this share more: all of it each time."""
_DAMPING_TRIES = 5
_BANDED = 1.5
"""Times the width of its band that a system is large at least to be solved as one."""
_LONGEST, _STAGGER = 100, 61
"""Frames over which a track counts as one point; a longer one is two or more. One that lasts for all of a long clip would join
all of its poses, and time grow with the cube of their number. Where one is cut, and by how many frames later the next one."""


@dataclass(frozen=True)
class Observations:
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
    def of_tracks(positions: np.ndarray, seen: np.ndarray, K: np.ndarray) -> Observations:
        """From tracks: positions [N, T, 2] in pixels, and where they count, seen [N, T]."""
        point, frame = np.nonzero(seen)
        first = np.searchsorted(point, np.arange(len(seen) + 1))
        x = (positions[point, frame].astype(np.float64) - K[:2, 2]) / [K[0, 0], K[1, 1]]
        return Observations(first, frame, np.ascontiguousarray(x), seen.shape[1], float(K[0, 0]))

    def in_pieces(self) -> Observations:
        """The same, with points that were seen over more than ``_LONGEST`` frames as several.

        Each is cut at frames of its own: poses on either side of a cut are known relative to each other by all others.
        """
        point = self.point_of
        since = self.frame_of - self.frame_of[self.first[point]]
        cut_from = np.zeros(self.points, np.int64)
        late = point[since >= _LONGEST]
        cut_from[late] = _STAGGER * late % _LONGEST
        piece = (since + cut_from[point]) // _LONGEST
        starts = np.flatnonzero(np.diff(self.point_of, prepend=-1) | np.diff(piece, prepend=0))
        return replace(self, first=np.append(starts, len(self.x)))


@dataclass(frozen=True)
class RigidMotion:
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
    observations: Observations

    def residuals(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of every observation: pixels that it is off, its depth in the object's unit, and whether it is explained at all [M]."""
        o, point = self.observations, self.observations.point_of
        y = np.einsum("mij,mj->mi", self.turns[o.frame_of], self.points[point]) + self.shifts[o.frame_of]
        off = o.focal * np.linalg.norm(y[:, :2] / np.maximum(y[:, 2:], NEAREST) - o.x, axis=1)
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
        return float((off[explained] < INLIER).mean()) if explained.any() else 0.0

    def log_depths(self) -> np.ndarray:
        """[T] median logarithm of the depth of the agreeing observations of each frame; NaN where fewer than three agree."""
        off, depth, explained = self.residuals()
        good = explained & (off < INLIER) & (depth > NEAREST)
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


def pose_information(motion: RigidMotion) -> tuple[np.ndarray, np.ndarray]:
    """Used frames [F], and the information [6F, 6F] on their poses (turn, shift) for a noise of one pixel, points eliminated."""
    o, frames = motion.observations, np.flatnonzero(motion.used)
    place = np.full(o.frames, -1)
    place[frames] = np.arange(len(frames))
    turns, shifts = motion.turns[frames], motion.shifts[frames]
    prior = _unevenness(turns, shifts)[0]
    H = _reduced_system(
        turns, shifts, motion.points, o.first, place[o.frame_of], o.x, motion.known, o.focal, RESIDUAL_WIDTH,
        RELIEF_RIDGE / motion.size**2, 0.0, _reach(o.first, place[o.frame_of], motion.known),
    )[0]  # fmt: skip
    H[:, : prior.shape[1]] += prior
    return frames, _unpacked(H)


def longest(seen: np.ndarray, most: int = PER_FRAME) -> np.ndarray:
    """Indices of the longest of the tracks seen [N, T], until nearly every frame of theirs has ``most``."""
    have, kept = np.zeros(seen.shape[1], int), []
    for n in np.argsort(-seen.sum(1), kind="stable"):
        if seen[n].any() and (have[seen[n]] < most).mean() > 0.3:
            kept.append(n)
            have[seen[n]] += 1
    return np.sort(np.array(kept, int))


def solve_rigid(observations: Observations) -> RigidMotion | None:
    """The motion of a rigid object from its tracks, and the better of it and its mirror image (Necker's ambiguity).

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


def refine_rigid(motion: RigidMotion, observations: Observations, points: np.ndarray) -> RigidMotion:
    """A motion that is known roughly, from other observations of the same object and their rough points [N, 3]."""
    solver = _Solver(observations)
    solver.resume(motion, points)
    solver.adjust(_FINAL_ITERATIONS, 1e-4)
    return solver.result()


class _Solver:
    def __init__(self, observations: Observations):
        self._o = o = observations
        self._turns, self._shifts = np.tile(np.eye(3), (o.frames, 1, 1)), np.zeros((o.frames, 3))
        self._points = np.zeros((o.points, 3))
        self._used, self._known = np.zeros(o.frames, bool), np.zeros(o.points, bool)
        self._size, self._cost, self._reference = 0.1, np.inf, 0
        self._point_of = o.point_of
        self._rows = [np.flatnonzero(o.frame_of == t) for t in range(o.frames)]

    def resume(self, motion: RigidMotion, points: np.ndarray) -> None:
        """The poses of a motion that was found before, in the frames that still see enough points."""
        o = self._o
        self._known = np.isfinite(points).all(1)
        counts = np.bincount(o.frame_of[self._known[self._point_of]], minlength=o.frames)
        self._used = motion.used & (counts >= FEWEST_SHARED)
        self._turns, self._shifts = motion.turns.copy(), motion.shifts.copy()
        self._points = np.where(self._known[:, None], points, 0)
        self._size, self._reference = motion.size, int(counts.argmax())

    def begin(self) -> bool:
        """A flat card in the frame with the most long tracks; False where no frame sees enough of them."""
        o = self._o
        lengths = np.minimum(np.diff(o.first), 40).astype(float)
        self._reference = int(np.bincount(o.frame_of, lengths[self._point_of], o.frames).argmax()) if len(o.x) else 0
        rows = self._rows[self._reference]
        if len(rows) < FEWEST_SHARED:
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
            if len(old) < FEWEST_SHARED:
                continue
            near = np.flatnonzero(self._used)
            self._place(t, int(near[np.abs(near - t).argmin()]), old)
            rays = np.concatenate([o.x[new], np.ones((len(new), 1))], 1)
            self._points[self._point_of[new]] = (rays * self._shifts[t, 2] - self._shifts[t]) @ self._turns[t]
            self._known[self._point_of[new]] = True
            used = int(self._used.sum())
            if used - adjusted >= max(_ADJUST_EVERY, _ADJUST_SHARE * used):
                self.adjust(_GROW_ITERATIONS, 1e-3)
                adjusted = used

    def _place(self, t: int, near: int, rows: np.ndarray) -> None:
        """The pose of frame t, begun from that of frame ``near`` by how the points grew and shifted."""
        o, points = self._o, self._points[self._point_of[rows]]
        y = points @ self._turns[near].T + self._shifts[near]
        before, now = y[:, :2] / np.maximum(y[:, 2:], NEAREST), o.x[rows]
        z = self._shifts[near, 2] / np.clip(_radius(now) / _radius(before), 0.7, 1.4)
        middle = self._shifts[near, :2] / self._shifts[near, 2] + np.median(now - before, 0)
        shift = np.array([*(middle * z), z])
        self._turns[t], self._shifts[t] = _refine_pose(
            self._turns[near].copy(), shift, points, np.ascontiguousarray(now), o.focal, RESIDUAL_WIDTH, _POSE_ITERATIONS
        )
        self._used[t] = True

    def adjust(self, iterations: int, tolerance: float) -> None:
        """Levenberg-Marquardt over used frames and known points."""
        o, frames = self._o, np.flatnonzero(self._used)
        place = np.full(o.frames, -1)
        place[frames] = np.arange(len(frames))
        turns, shifts, points = self._turns[frames], self._shifts[frames], self._points
        ridge = RELIEF_RIDGE / self._size**2
        fixed = o.first, place[o.frame_of], o.x, self._known, o.focal, RESIDUAL_WIDTH, ridge
        reach = _reach(o.first, place[o.frame_of], self._known)
        damping, cost = 1e-3, _cost(turns, shifts, points, *fixed) + _unevenness(turns, shifts)[2]
        for _ in range(iterations):
            prior, pull, _ = _unevenness(turns, shifts)
            after = np.inf
            for _ in range(_DAMPING_TRIES):
                H, b, own, inverses, gradients, links = _reduced_system(turns, shifts, points, *fixed, damping, reach)
                H[:, : prior.shape[1]] += prior
                H[:, 0] += damping * (own + prior[:, 0]) + 1e-9
                step = _solved(H, b + pull)
                moved = _moved_points(points, step, o.first, fixed[1], inverses, gradients, links, self._known)
                new_turns = _turned(turns, step)
                new_shifts = shifts + step.reshape(-1, 6)[:, 3:]
                after = _cost(new_turns, new_shifts, moved, *fixed) + _unevenness(new_turns, new_shifts)[2]
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
        scale = np.exp(np.mean(np.log(np.maximum(shifts[:, 2], NEAREST))))
        self._turns[frames], self._shifts[frames] = turns, shifts / scale
        self._points = np.where(self._known[:, None], (points - middle) / scale, 0)
        self._cost = cost

    def mirror(self) -> _Solver:
        """The same with mirrored relief and mirrored turns, which looks almost the same."""
        other = _Solver(self._o)
        other._used, other._known, other._size = self._used.copy(), self._known.copy(), self._size
        other._reference, other._shifts = self._reference, self._shifts.copy()
        flip, start = np.diag([1.0, 1, -1]), self._turns[self._reference]
        other._points = self._points @ start.T @ flip @ start
        other._turns = flip @ (self._turns @ start.T) @ flip @ start
        return other

    def result(self) -> RigidMotion:
        return RigidMotion(
            self._turns, self._shifts, self._points, self._used, self._known, self._size, float(self._cost), self._o
        )


def _solved(H: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The solution of H x = b, H symmetric and positive, as a band: [n, w] holds its entries (i, i + d)."""
    n, band = H.shape
    try:
        if _BANDED * band > n:
            return np.asarray(cho_solve(cho_factor(_unpacked(H), overwrite_a=True, check_finite=False), b, check_finite=False))
        return np.asarray(solveh_banded(H.T, b, lower=True, check_finite=False))
    except np.linalg.LinAlgError:  # It is positive but for rounding.
        return np.linalg.solve(_unpacked(H), b)


def _radius(x: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(x - np.median(x, 0), axis=1))) + 1e-6


def _unevenness(turns: np.ndarray, shifts: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Prior of even motion as normal equations, a band [6F, 13] and [6F], and cost: second differences, weighed ``SMOOTHNESS``."""
    return _second_differences(turns, shifts, SMOOTHNESS)


# -- kernels; a pose is six numbers: a small turn from the left in object axes of the camera, then a shift


@njit(cache=True)
def _rotation(v: np.ndarray) -> np.ndarray:
    """Rodrigues' formula."""
    angle = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    if angle < 1e-9:
        return np.eye(3) + K
    return np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * (K @ K)


@njit(cache=True)
def _turned(turns: np.ndarray, step: np.ndarray) -> np.ndarray:
    result = np.empty_like(turns)
    for f in range(len(turns)):
        result[f] = _rotation(step[6 * f : 6 * f + 3]) @ turns[f]
    return result


@njit(cache=True)
def _second_differences(turns: np.ndarray, shifts: np.ndarray, weight: float) -> tuple[np.ndarray, np.ndarray, float]:
    F = len(turns)
    A, b, cost = np.zeros((6 * F, 13)), np.zeros(6 * F), 0.0
    c, r = np.array([1.0, -2.0, 1.0]), np.zeros(6)
    for i in range(1, F - 1):
        D = (turns[i + 1] @ turns[i].T) @ (turns[i] @ turns[i - 1].T).T
        r[0], r[1], r[2] = 0.5 * (D[2, 1] - D[1, 2]), 0.5 * (D[0, 2] - D[2, 0]), 0.5 * (D[1, 0] - D[0, 1])
        for d in range(3):
            r[3 + d] = shifts[i - 1, d] - 2 * shifts[i, d] + shifts[i + 1, d]
        for d in range(6):
            cost += weight * r[d] * r[d]
            for p in range(3):
                b[6 * (i + p - 1) + d] -= weight * c[p] * r[d]
                for q in range(p, 3):
                    A[6 * (i + p - 1) + d, 6 * (q - p)] += weight * c[p] * c[q]
    return A, b, cost


@njit(cache=True)
def derivatives(
    Q: np.ndarray, tau: np.ndarray, S: np.ndarray, x: np.ndarray, focal: float, r: np.ndarray, J: np.ndarray, B: np.ndarray
) -> None:
    """Residual r [2] of one observation, its derivatives J [2, 6] by the pose and B [2, 3] by the point."""
    y0 = Q[0, 0] * S[0] + Q[0, 1] * S[1] + Q[0, 2] * S[2]
    y1 = Q[1, 0] * S[0] + Q[1, 1] * S[1] + Q[1, 2] * S[2]
    y2 = Q[2, 0] * S[0] + Q[2, 1] * S[1] + Q[2, 2] * S[2]
    X, Y, Z = y0 + tau[0], y1 + tau[1], max(y2 + tau[2], 0.05)
    u, v, f = X / Z, Y / Z, focal / Z
    r[0], r[1] = focal * (u - x[0]), focal * (v - x[1])
    # d(pixel) / d(point in camera axes) = f (1, 0, -u; 0, 1, -v); turning by w moves y by w x y.
    J[0, 0], J[0, 1], J[0, 2] = -f * u * y1, f * (y2 + u * y0), -f * y1
    J[1, 0], J[1, 1], J[1, 2] = -f * (y2 + v * y1), f * v * y0, f * y0
    J[0, 3], J[0, 4], J[0, 5] = f, 0.0, -f * u
    J[1, 3], J[1, 4], J[1, 5] = 0.0, f, -f * v
    for d in range(3):
        B[0, d] = f * (Q[0, d] - u * Q[2, d])
        B[1, d] = f * (Q[1, d] - v * Q[2, d])


@njit(cache=True)
def _cost(
    turns: np.ndarray, shifts: np.ndarray, points: np.ndarray, first: np.ndarray, frame_of: np.ndarray, x: np.ndarray,
    known: np.ndarray, focal: float, width: float, ridge: float,
) -> float:  # fmt: skip
    total = 0.0
    for n in range(len(points)):
        if not known[n]:
            continue
        S = points[n]
        total += ridge * (S[0] * S[0] + S[1] * S[1] + S[2] * S[2])
        for m in range(first[n], first[n + 1]):
            t = frame_of[m]
            if t < 0:
                continue
            Q, tau = turns[t], shifts[t]
            X = Q[0, 0] * S[0] + Q[0, 1] * S[1] + Q[0, 2] * S[2] + tau[0]
            Y = Q[1, 0] * S[0] + Q[1, 1] * S[1] + Q[1, 2] * S[2] + tau[1]
            Z = max(Q[2, 0] * S[0] + Q[2, 1] * S[1] + Q[2, 2] * S[2] + tau[2], 0.05)
            a, b = focal * (X / Z - x[m, 0]), focal * (Y / Z - x[m, 1])
            total += width**2 * np.log1p((a * a + b * b) / width**2)
    return total


@njit(cache=True)
def _reduced_system(
    turns: np.ndarray, shifts: np.ndarray, points: np.ndarray, first: np.ndarray, frame_of: np.ndarray, x: np.ndarray,
    known: np.ndarray, focal: float, width: float, ridge: float, damping: float, reach: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Normal equations of the poses with the points eliminated. ``reach``: as from ``_reach``.

    Returns:
        H, of whose row i [6F, 6 (reach + 1)] holds the columns from i on, b [6F]; the diagonal [6F] of the poses' own block;
        and to get the points' steps: inverse [N, 3, 3] of each point's block, its right side [N, 3], and the block [M, 3, 6]
        between the point and the pose of an observation.
    """
    F, N, M = len(turns), len(points), len(x)
    H, b, own = np.zeros((6 * F, 6 * (reach + 1))), np.zeros(6 * F), np.zeros(6 * F)
    inverses, gradients, links = np.zeros((N, 3, 3)), np.zeros((N, 3)), np.zeros((M, 3, 6))
    r, J, B = np.zeros(2), np.zeros((2, 6)), np.zeros((2, 3))
    V, WV = np.zeros((3, 3)), np.zeros((6, 3))
    for n in range(N):
        if not known[n]:
            continue
        V[:] = 0.0
        for d in range(3):
            V[d, d] = ridge
            gradients[n, d] = -ridge * points[n, d]
        for m in range(first[n], first[n + 1]):
            t = frame_of[m]
            if t < 0:
                continue
            derivatives(turns[t], shifts[t], points[n], x[m], focal, r, J, B)
            u = 1.0 / (1.0 + (r[0] * r[0] + r[1] * r[1]) / width**2)
            for i in range(6):
                b[6 * t + i] -= u * (J[0, i] * r[0] + J[1, i] * r[1])
                for j in range(i, 6):
                    H[6 * t + i, j - i] += u * (J[0, i] * J[0, j] + J[1, i] * J[1, j])
                for j in range(3):
                    links[m, j, i] = u * (J[0, i] * B[0, j] + J[1, i] * B[1, j])
            for i in range(3):
                gradients[n, i] -= u * (B[0, i] * r[0] + B[1, i] * r[1])
                for j in range(3):
                    V[i, j] += u * (B[0, i] * B[0, j] + B[1, i] * B[1, j])
        for d in range(3):
            V[d, d] *= 1 + damping
        inverses[n] = np.linalg.inv(V)
    for d in range(6 * F):
        own[d] = H[d, 0]
    for n in range(N):
        if not known[n]:
            continue
        P = inverses[n]
        for m in range(first[n], first[n + 1]):
            t = frame_of[m]
            if t < 0:
                continue
            for i in range(6):
                for j in range(3):
                    WV[i, j] = links[m, 0, i] * P[0, j] + links[m, 1, i] * P[1, j] + links[m, 2, i] * P[2, j]
                b[6 * t + i] -= WV[i, 0] * gradients[n, 0] + WV[i, 1] * gradients[n, 1] + WV[i, 2] * gradients[n, 2]
            for k in range(m, first[n + 1]):  # Frames rise, so this is the upper half.
                s = frame_of[k]
                if s < 0:
                    continue
                for i in range(6):
                    w0, w1, w2 = WV[i, 0], WV[i, 1], WV[i, 2]
                    for j in range(i if s == t else 0, 6):
                        H[6 * t + i, 6 * (s - t) + j - i] -= w0 * links[k, 0, j] + w1 * links[k, 1, j] + w2 * links[k, 2, j]
    return H, b, own, inverses, gradients, links


@njit(cache=True)
def _unpacked(H: np.ndarray) -> np.ndarray:
    """The whole symmetric matrix [n, n] of a band [n, w]."""
    n, band = H.shape
    whole = np.zeros((n, n))
    for i in range(n):
        for d in range(min(band, n - i)):
            whole[i, i + d] = whole[i + d, i] = H[i, d]
    return whole


@njit(cache=True)
def _reach(first: np.ndarray, frame_of: np.ndarray, known: np.ndarray) -> int:
    """How many frames apart poses are at most that one equation joins: those of a point, and the next but one."""
    most = 2
    for n in range(len(known)):
        low, high = -1, -1
        for m in range(first[n], first[n + 1]):
            t = frame_of[m]
            if known[n] and t >= 0:
                low, high = t if low < 0 else min(low, t), max(high, t)
        most = max(most, high - low)
    return most


@njit(cache=True)
def _moved_points(
    points: np.ndarray, step: np.ndarray, first: np.ndarray, frame_of: np.ndarray, inverses: np.ndarray, gradients: np.ndarray,
    links: np.ndarray, known: np.ndarray,
) -> np.ndarray:  # fmt: skip
    result, g = points.copy(), np.zeros(3)
    for n in range(len(points)):
        if not known[n]:
            continue
        g[:] = gradients[n]
        for m in range(first[n], first[n + 1]):
            t = frame_of[m]
            if t < 0:
                continue
            for j in range(3):
                for i in range(6):
                    g[j] -= links[m, j, i] * step[6 * t + i]
        result[n] += inverses[n] @ g
    return result


@njit(cache=True)
def _refine_pose(
    Q: np.ndarray, tau: np.ndarray, points: np.ndarray, x: np.ndarray, focal: float, width: float, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton for one pose, held against turning far."""
    r, J, B = np.zeros(2), np.zeros((2, 6)), np.zeros((2, 3))
    for _ in range(iterations):
        H, b = 1e-6 * np.eye(6), np.zeros(6)
        for d in range(3):
            H[d, d] += 0.5 * len(points)
        for n in range(len(points)):
            derivatives(Q, tau, points[n], x[n], focal, r, J, B)
            u = 1.0 / (1.0 + (r[0] * r[0] + r[1] * r[1]) / width**2)
            for i in range(6):
                b[i] -= u * (J[0, i] * r[0] + J[1, i] * r[1])
                for j in range(6):
                    H[i, j] += u * (J[0, i] * J[0, j] + J[1, i] * J[1, j])
        step = np.linalg.solve(H, b)
        Q, tau = _rotation(step[:3]) @ Q, tau + step[3:]
    return Q, tau
