"""The path of a rigid object through the world, known up to its distance, and what that path says about the distance.

In world axes r_t = W_t^T tau_t and R_t = W_t^T Q_t (W_t: the camera's rotation), and a body point q is at
X_t = C_t + s (r_t + R_t q). Only s is unknown. With w = 1 / s every statement that some point of the body obeys a law in
the world is linear in (w, q) and the law's own parameters: N (r + R q + w C) = B p. It is solved by generalized least
squares with the covariance of all poses: noise along the ray dominates, so variances alone would not do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowsplat.geometry import Camera
from flowsplat.priors.objects.rigid import RigidSolution, pose_information, widest_turn

VARIANCE_INFLATION = 4.0
"""Factor on the variance of tracks: their errors last for frames, so that they average out less than white noise. Chosen by eye."""
MODEL_ERROR = 0.01
"""Share of an object's size by which any law of motion is off. Chosen by eye."""
MAX_REDUCED_CHI_SQUARE = 3.0
"""chi^2 per degree of freedom above which a path does not obey a law. As errors last for ``VARIANCE_INFLATION`` frames, 40 frames
are worth ten independent ones, and where the law holds their chi^2 is above 3 a degree less than once in a thousand."""
BOUNCE_SPAN = 2
"""Frames to either side over which the second difference of a height is taken. Chosen by eye."""
MIN_BOUNCE, BOUNCE_WIDTH = 1.5, 4
"""Second difference at a bounce, in units of that in free flight; so many frames from it there is free flight again
(docs/method/objects.md)."""
MAX_FLIGHT_SPREAD = 1.2
"""Spread of the second differences over time, in units of their median, up to which it is free flight. Chosen by eye."""
MIN_CURVED_FRAMES = 8
"""Second differences of the height below which no bounce is looked for. Chosen by eye."""


@dataclass(frozen=True)
class WorldPath:
    """Relative positions and turns of an object, in its own unit of length.

    Attributes:
        frames: [F] positions in the clip.
        relative: [F, 3] r_t.
        turns: [F, 3, 3] R_t.
        centers: [F, 3] C_t of the cameras, in the scene's unit.
        covariance: [6F, 6F] of (turn, shift) of all poses, in world axes.
        size: half the width of the object, in its own unit.
        middle: [3] the median of its points.
    """

    frames: np.ndarray
    relative: np.ndarray
    turns: np.ndarray
    centers: np.ndarray
    covariance: np.ndarray
    size: float
    middle: np.ndarray

    @staticmethod
    def of(motion: RigidSolution, cameras: Sequence[Camera]) -> WorldPath:
        """In world axes, from the poses in the object's frame; ``cameras`` [T] of the clip."""
        frames, information = pose_information(motion)
        turns, shifts, F = motion.turns[frames], motion.shifts[frames], len(frames)
        # Seven directions change no image: turning and moving the object's frame, and its scale. They are held.
        free = np.zeros((F, 6, 7))
        free[:, :3, :3] = free[:, 3:, 3:6] = turns
        free[:, 3:, 6] = shifts
        held = np.linalg.qr(free.reshape(6 * F, 7))[0]
        stiffness = 1e3 * np.median(np.diag(information))
        covariance = (
            np.linalg.inv(information + stiffness * held @ held.T + 1e-9 * np.eye(6 * F)) * motion.noise**2 * VARIANCE_INFLATION
        )
        to_world = np.array([cameras[t].viewmat[:3, :3].T for t in frames])
        blocks = np.zeros((F, 2, 3, F, 2, 3))
        for f in range(F):
            blocks[f, 0, :, f, 0] = blocks[f, 1, :, f, 1] = to_world[f]
        turner = blocks.reshape(6 * F, 6 * F)
        return WorldPath(
            frames, np.einsum("fij,fj->fi", to_world, shifts), to_world @ turns,
            np.array([cameras[t].center for t in frames]), turner @ covariance @ turner.T, motion.size,
            np.median(motion.points[motion.known], 0),
        )  # fmt: skip

    @property
    def turned(self) -> float:
        """Degrees between the two orientations in the world that differ most."""
        return widest_turn(self.turns)

    def covariance_of(self, q: np.ndarray) -> np.ndarray:
        """Return [3F, 3F] covariance of r + R q."""
        F, y = len(self.frames), self.turns @ q
        J, i, zero = np.zeros((F, 3, F, 6)), np.arange(len(self.frames)), np.zeros(len(self.frames))
        cross = np.array([[zero, y[:, 2], -y[:, 1]], [-y[:, 2], zero, y[:, 0]], [y[:, 1], -y[:, 0], zero]])
        J[i, :, i, :3] = cross.transpose(2, 0, 1)
        J[i, :, i, 3:] = np.eye(3)
        flat = J.reshape(3 * F, 6 * F)
        return flat @ self.covariance @ flat.T


@dataclass(frozen=True)
class Law:
    """What a law of motion says about w = 1 / s.

    Attributes:
        nearness: w.
        sigma: standard deviation of ln w.
        fit: chi^2 per degree of freedom.
        measures: of the law at hand, for its gate.
    """

    nearness: float
    sigma: float
    fit: float
    measures: dict[str, float]

    @property
    def usable(self) -> bool:
        """Whether w is positive and known to 20 %."""
        return bool(np.isfinite(self.nearness) and self.nearness > 0 and self.sigma <= 0.2)

    @property
    def holds(self) -> bool:
        """Whether the path is off the law by no more than its noise: else no w is right, however well one is known."""
        return bool(self.fit <= MAX_REDUCED_CHI_SQUARE)


def pivot(path: WorldPath) -> Law:
    """Return some point of the body, also one outside what is seen, stays where it is."""
    F = len(path.frames)
    x, variance, fit, _ = _fit(path, np.eye(3 * F), np.tile(np.eye(3), (F, 1)), 6.0)
    travel = path.relative + x[0] * path.centers
    rest = _spread(travel + path.turns @ x[1:4]) / max(_spread(travel), 1e-12)
    return _law(x, variance, fit, rest=rest, turned=path.turned)


def constant_height(path: WorldPath, normal: np.ndarray) -> Law:
    """Return some point near its middle keeps its height over the ground (normal [3]): what rolls, slides and drives."""
    F = len(path.frames)
    x, variance, fit, off = _fit(path, np.kron(np.eye(F), normal[None]), np.ones((F, 1)), 0.5)
    rho = float(np.clip((off[1:] * off[:-1]).sum() / max(float((off * off).sum()), 1e-9), 0, 0.9))
    own = max(float(np.var(path.relative @ normal)), 1e-12)
    explained = 1 - float(np.var((path.relative + x[0] * path.centers) @ normal)) / own
    return _law(x, variance * (1 + rho) / (1 - rho), fit, explained=explained)


def bounce_frames(path: WorldPath, normal: np.ndarray, scale: float) -> np.ndarray:
    """Return frames [B] in which the body was thrown up while it fell freely before and after.

    In free flight the second difference of its height over time is the same negative number; at a bounce it is many times that,
    upwards, for a moment. What swings has a smooth minimum, what rolls or stands none.

    Args:
        normal: [3] up.
        scale: s, roughly: it weighs the camera's own height, whose second difference is small.
    """
    n, T = BOUNCE_SPAN, int(path.frames[-1]) + 1 if len(path.frames) else 0
    height = np.full(T, np.nan)
    height[path.frames] = (path.centers + scale * (path.relative + path.turns @ path.middle)) @ normal
    curved = np.full(T, np.nan)
    curved[n : T - n] = height[2 * n :] - 2 * height[n : T - n] + height[: T - 2 * n]
    known = curved[np.isfinite(curved)]
    if len(known) < MIN_CURVED_FRAMES:
        return np.zeros(0, int)
    falling = -float(np.median(known))
    spread = 1.5 * float(np.median(np.abs(known + falling)))
    if falling <= 0 or spread > MAX_FLIGHT_SPREAD * falling:
        return np.zeros(0, int)
    found = []
    for k in np.flatnonzero(np.isfinite(curved)):
        around = curved[max(k - BOUNCE_WIDTH, 0) : k + BOUNCE_WIDTH + 1]
        if curved[k] < MIN_BOUNCE * falling or curved[k] < np.nanmax(around):
            continue
        sides = [curved[j] for j in (k - BOUNCE_WIDTH, k + BOUNCE_WIDTH) if 0 <= j < T and np.isfinite(curved[j])]
        if sides and max(sides) <= 0:
            found.append(int(k))
    return np.array(found, int)


def _law(x: np.ndarray, variance: float, fit: float, **measures: float) -> Law:
    return Law(float(x[0]), float(np.sqrt(max(variance, 0)) / max(abs(x[0]), 1e-12)), float(fit), measures)


def _spread(points: np.ndarray) -> float:
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(-1).mean()))


def _fit(path: WorldPath, N: np.ndarray, B: np.ndarray, lever: float) -> tuple[np.ndarray, float, float, np.ndarray]:
    """N (r + R q + w C) = B p for w, q (within about ``lever`` sizes) and p: x = (w, q, p), var(w), chi^2 / dof, residual."""
    y = -N @ path.relative.ravel()
    A = np.concatenate([(N @ path.centers.ravel())[:, None], N @ path.turns.reshape(-1, 3), -B], 1)
    prior = np.r_[0, np.full(3, 1 / (lever * path.size) ** 2), np.zeros(B.shape[1])] + 1e-9
    q = np.zeros(3)
    for _ in range(4):
        covariance = N @ path.covariance_of(q) @ N.T + (MODEL_ERROR * path.size) ** 2 * np.eye(len(y))
        x, own, chi, off = _least_squares(A, y, covariance, prior)
        q = x[1:4]
    fit = chi / max(len(y) - A.shape[1], 1)
    return x, own[0, 0] * max(1.0, fit), fit, off


def _least_squares(
    A: np.ndarray, y: np.ndarray, covariance: np.ndarray, prior: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Generalized least squares with prior precisions: parameters, their covariance, chi^2, whitened residuals."""
    L = np.linalg.cholesky(covariance + 1e-12 * np.trace(covariance) / len(covariance) * np.eye(len(covariance)))
    a, b = np.linalg.solve(L, A), np.linalg.solve(L, y)
    H = a.T @ a + np.diag(prior)
    # What the data do not tell, the distance before a camera that stands, say, stays unsure instead of singular.
    H += 1e-12 * np.trace(H) / len(H) * np.eye(len(H))
    x = np.linalg.solve(H, a.T @ b)
    off = b - a @ x
    return x, np.linalg.inv(H), float(off @ off + (prior * x**2).sum()), off
