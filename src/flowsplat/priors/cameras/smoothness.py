"""A smoothness prior on the path of a camera, as strong as the clip itself tells.

Where a camera hardly travels, a shift of it in one frame looks almost like a small turn. Tracks leave that shift open, and what is
fitted to them alone jumps to and fro from frame to frame. Most of the scene does not show it, as the turn makes up for it; what
is nearer or farther does. So third differences of the camera's places are taken for draws from a Student distribution about
zero, whose scale has the largest evidence (MacKay, "Bayesian interpolation", https://doi.org/10.1162/neco.1992.4.3.415). What
tracks determine stays as they say, and a camera that shakes keeps its shake.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowsplat.priors.cameras.bundle import (
    LENS_PARAMETERS,
    LensPrior,
    Reconstruction,
    adjust,
    compute_scale_direction,
    free_parameters,
    information,
    residuals,
)
from flowsplat.priors.cameras.observations import Observations

THIRD_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])
"""Third ones over time, of the camera's places: a steady curve, as round something, has none to speak of."""
MIN_FRAMES = 8
"""Frames below which there is no telling how smoothly a camera travels. Chosen by eye."""
STUDENT_DEGREES = 4.0
"""Of freedom of the Student distribution: a jolt now and then is no sign of a camera that shakes (docs/method/cameras.md)."""
CORRELATED_SHARE = 0.25
"""Share of a track over which its errors, and those of its neighbors, are alike, so that they tell as much as one observation.
Chosen on workshop, garden, train, bear and random worlds (docs/method/cameras.md; docs/notebook/2026-11.md)."""
_SCALE_ROUNDS, _ROUND_ITERATIONS, _LAST_ITERATIONS = 8, 2, 10
"""Estimates of the scale, at most; iterations of the adjustment in each; and those of the last adjustment. Chosen by eye."""
_SCALE_TOLERANCE = 0.03
"""Change of the logarithm of the squared scale below which it is found. Chosen by eye."""
_MAX_CURVATURE_RATIO = 1e3
"""Times the median curvature that the scale of all is held by. Chosen by eye."""


@dataclass(frozen=True)
class SmoothnessPrior:
    """Pulls third differences of the camera's places to zero.

    Attributes:
        weights: [T - 3] square pixels of cost for a square unit of length.
    """

    weights: np.ndarray

    def compute_cost(self, state: Reconstruction) -> float:
        """Return square pixels."""
        return float((self.weights[:, None] * differences(state) ** 2).sum())

    def add_to(self, H: np.ndarray, g: np.ndarray, state: Reconstruction) -> None:
        """Add the gradient and the curvature to the normal equations, in place."""
        J, weights = _derivatives(state), np.repeat(self.weights, 3)
        poses = slice(0, J.shape[1])
        H[poses, poses] += J.T @ (weights[:, None] * J)
        g[poses] -= J.T @ (weights * differences(state).ravel())


def smooth_path(
    state: Reconstruction, seen: Observations, *, scale: float, fixed_camera: int, lens: LensPrior, free_focal: bool,
    free_distortion: bool,
) -> Reconstruction:  # fmt: skip
    """Adjusted cameras and points once more, with the prior on their path.

    Args:
        state: adjusted to the tracks alone; its cameras are of frames that follow each other.
        seen: what rests, and only that.
        scale: pixels, as for ``adjust``.
    """
    count = len(state.rotations)
    squared = (differences(state) ** 2).sum(1)
    if count < MIN_FRAMES or not np.median(squared) > 0:
        return state
    error, _ = residuals(state, seen)
    alike = max(1.0, CORRELATED_SHARE * len(error) / len(np.unique(seen.point)))
    variance = alike * float(np.median(error)) ** 2 / (2 * np.log(2))
    spread, weights = float(np.median(squared)) / 3, np.ones(count - len(THIRD_DIFFERENCE) + 1)

    index = free_parameters(count, fixed_camera, free_focal, free_distortion)

    def step(iterations: int) -> tuple[Reconstruction, SmoothnessPrior]:
        path = SmoothnessPrior(variance / spread * weights)
        done = adjust(
            state, seen, iterations=iterations, scale=scale, fixed_camera=fixed_camera, free_focal=free_focal,
            free_distortion=free_distortion, priors=(lens, path),
        )  # fmt: skip
        return done.reconstruction, path

    for _ in range(_SCALE_ROUNDS):
        state, path = step(_ROUND_ITERATIONS)
        left = _uncertainty(state, information(state, seen, scale, (lens, path)), index, fixed_camera) * variance
        squares = differences(state) ** 2
        # Of each difference the share that the tracks tell, not the prior.
        told = float(np.clip(1 - left * weights[:, None] / spread, 1e-3, 1).sum())
        before, spread = spread, max(float((weights[:, None] * squares).sum()) / told, 1e-18)
        weights = (STUDENT_DEGREES + 3) / (STUDENT_DEGREES + (squares + left).sum(1) / spread)
        if abs(np.log(spread / before)) < _SCALE_TOLERANCE:
            break
    return step(_LAST_ITERATIONS)[0]


def differences(state: Reconstruction) -> np.ndarray:
    """Return [T - 3, 3] third differences of the camera's places."""
    places, count = state.centers, len(state.rotations) - len(THIRD_DIFFERENCE) + 1
    return sum(factor * places[k : k + count] for k, factor in enumerate(THIRD_DIFFERENCE))


def _derivatives(state: Reconstruction) -> np.ndarray:
    """Return [3 (T - 3), 6T] of the differences by steps of the poses, as ``adjust`` makes them."""
    turns, (x, y, z) = state.rotations, state.translations.T
    count, zero = len(turns), np.zeros(len(turns))
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    back = turns.transpose(0, 2, 1)
    places = np.concatenate([-back @ cross, -back], 2)
    rows = count - len(THIRD_DIFFERENCE) + 1
    J, i = np.zeros((rows, 3, count, 6)), np.arange(rows)
    for shift, factor in enumerate(THIRD_DIFFERENCE):
        J[i, :, i + shift] = factor * places[shift : shift + rows]
    return J.reshape(3 * rows, 6 * count)


def _uncertainty(state: Reconstruction, curvature: np.ndarray, index: np.ndarray, fixed_camera: int) -> np.ndarray:
    """Return [T - 3, 3] variance of the differences where observations have a variance of one square pixel.

    Args:
        curvature: [6T + LENS, 6T + LENS] as from ``information``.
        index: of the parameters that may change.
    """
    larger, S = np.zeros(len(curvature)), curvature[np.ix_(index, index)]
    larger[:-LENS_PARAMETERS].reshape(-1, 6)[:, 3:] = compute_scale_direction(state, fixed_camera)
    larger, usual = larger[index], float(np.median(np.diag(S)))
    S = (
        S
        + _MAX_CURVATURE_RATIO * usual * np.outer(larger, larger) / max(float(larger @ larger), 1e-30)
        + 1e-9 * usual * np.eye(len(S))
    )
    J = np.pad(_derivatives(state), ((0, 0), (0, LENS_PARAMETERS)))[:, index]
    return np.einsum("ij,ji->i", J, np.linalg.solve(S, J.T)).reshape(-1, 3)
