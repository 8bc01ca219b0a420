"""The last word on the cameras: many tracks, several rounds, and in each only the tracks that behave as static points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flowsplat.priors.cameras.bundle import USUAL_DISTORTION, LensPrior, Reconstruction, adjust, rays, residuals
from flowsplat.priors.cameras.growth import triangulate
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.smoothness import smooth_path

MAX_POINT_DEPTH = 100.0
"""Points are kept within this many median depths: a ray without parallax then fixes rotations, not depths. Chosen by eye."""
ROUGH_SCALES = (1.0, 0.5)
"""Scale of the Cauchy cost in pixels, a round, where cameras are only to be compared with others. Chosen by eye."""
LATE_SCALES = (0.5, 0.2)
"""The same for cameras that have been through the rough rounds. Chosen by eye."""
FINAL_TOLERANCE = 1e-5
"""An adjustment ends when an iteration lowers its cost by less than this fraction. Chosen by eye."""
ROUGH_TOLERANCE = 1e-4
"""The same of all rounds before the last. Chosen by eye."""
MAX_ITERATIONS, MAX_LENS_ITERATIONS = 40, 150
"""Of an adjustment at most, and of one that finds the distortion of the lens: with a longer lens in its place nearly all of it
can be explained, and the way back is narrow (docs/method/cameras.md)."""
ERROR_UNIT = 0.5
"""Pixels; errors well beyond it add little to the robust cost by which cameras are compared. Chosen by eye."""
MAX_ERROR = 20 * ERROR_UNIT
"""Pixels that any larger error counts as, and a point behind the camera."""
STATIC_SHARE = 0.6
"""Share of the observations that is assumed to stand still; the cameras are judged by those that fit best. Chosen by eye."""


@dataclass(frozen=True)
class Refined:
    """The refined cameras and what speaks for them.

    Attributes:
        state: poses of all given frames, focal length, one point a track.
        static: [N] bool, tracks that behave as static points.
        errors: [M] pixels, of the observations of static tracks.
        frames: [M] the frame of each of them.
        focal_sigma: standard deviation of log focal; infinite where the tracks do not determine it.
        distortion_sigma: standard deviation of the distortion; infinite where it was not estimated.
    """

    state: Reconstruction
    static: np.ndarray
    errors: np.ndarray
    frames: np.ndarray
    focal_sigma: float
    distortion_sigma: float = float("inf")


def with_points(state: Reconstruction, seen: Observations, *, free_translations: bool) -> Reconstruction:
    """Return the cameras with a point for each track: ``place_points`` where they may travel, else ``ray_points``."""
    place = place_points if free_translations else ray_points
    return replace(state, points=place(state, seen))


def place_points(state: Reconstruction, seen: Observations) -> np.ndarray:
    """Triangulated points [N, 3]; those that come out behind a camera or too far away are put far out on their ray."""
    points = triangulate(state, seen)
    _, depth = residuals(replace(state, points=points), seen)
    median = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    nearest, farthest = np.full(seen.points, np.inf), np.zeros(seen.points)
    np.minimum.at(nearest, seen.point, depth)
    np.maximum.at(farthest, seen.point, depth)
    lost = np.flatnonzero((nearest <= 1e-3 * median) | (farthest > MAX_POINT_DEPTH * median))
    half_way = seen.first[lost] + (seen.counts[lost] + 1) // 2 - 1
    middle = seen.camera[half_way]
    directions = rays(seen.uv[half_way], state.focal, state.distortion)
    ends = np.concatenate([directions, np.ones((len(lost), 1))], 1) * MAX_POINT_DEPTH * median
    points[lost] = np.einsum("nji,nj->ni", state.rotations[middle], ends - state.translations[middle])
    return points


def track_errors(state: Reconstruction, seen: Observations) -> np.ndarray:
    """Return [N] pixels: root mean square reprojection error of each track, infinite where it lies behind a camera."""
    error, depth = residuals(state, seen)
    squares = np.bincount(seen.point, np.where(depth > 0, error**2, np.inf), seen.points)
    return np.sqrt(squares / np.maximum(seen.counts, 1))


def ray_points(state: Reconstruction, seen: Observations) -> np.ndarray:
    """Return points [N, 3] at distance 1 in the mean direction of each track's rays, for cameras that share one center."""
    flat = rays(seen.uv, state.focal, state.distortion)
    unit = np.concatenate([flat, np.ones((len(flat), 1))], 1) / np.sqrt(1 + (flat**2).sum(1, keepdims=True))
    unit = np.einsum("mji,mj->mi", state.rotations[seen.camera], unit)
    points = np.stack([np.bincount(seen.point, unit[:, k], seen.points) for k in range(3)], 1)
    return points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)


def _with_others(state: Reconstruction, tracks: np.ndarray, points: np.ndarray) -> Reconstruction:
    """Return a reconstruction of the tracks with these indices alone, with the points [N, 3] of the others as they were."""
    result = points.copy()
    result[tracks] = state.points
    return replace(state, points=result)


def robust_errors(state: Reconstruction, seen: Observations) -> tuple[np.ndarray, np.ndarray]:
    """Errors [M] in pixels, ``MAX_ERROR`` at most, and their cost [M] without unit."""
    error, depth = residuals(state, seen)
    error = np.where(depth > 0, np.minimum(error, MAX_ERROR), MAX_ERROR)
    return error, np.log1p((error / ERROR_UNIT) ** 2)


def best_tracks(costs: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return indices of the tracks that fit best, by their summed costs [N] and how many observations they have [N]."""
    order = np.argsort(costs / np.maximum(counts, 1), kind="stable")
    return order[np.cumsum(counts[order]) <= STATIC_SHARE * counts.sum()]


def misfit(state: Reconstruction, seen: Observations, *, free_translations: bool = True) -> float:
    """Return how badly the cameras explain the tracks they explain best, a ``STATIC_SHARE`` of the observations.

    Assumes that most of what is seen stands still. A mean robust cost without unit, comparable between cameras for the
    same tracks, whatever tracks each of them was fitted to.
    """
    _, cost = robust_errors(with_points(state, seen, free_translations=free_translations), seen)
    totals, counts = np.bincount(seen.point, cost, seen.points), seen.counts
    best = best_tracks(totals, counts)
    return float(totals[best].sum() / max(counts[best].sum(), 1))


def refine(
    state: Reconstruction,
    seen: Observations,
    *,
    fixed_camera: int,
    expected_focal: float,
    free_focal: bool = True,
    free_translations: bool = True,
    free_distortion: bool = False,
    keep_points: bool = False,
    rough: bool = False,
    consecutive: bool = False,
) -> Refined:
    """Alternate between picking static tracks and adjusting everything to them.

    Args:
        state: poses to start from.
        seen: the tracks, in pixels from the principal point.
        expected_focal: pixels; decides where the tracks leave the focal length open.
        free_distortion: estimate the distortion of the lens, too.
        keep_points: start from the points of ``state`` instead of triangulating them.
        rough: from a first guess, only as far as is needed to compare these cameras with others.
        consecutive: the frames follow each other, so that the path is smoothed at the end, as far as the tracks leave it open.
    """
    static = np.zeros(seen.points, bool)
    precision = bend_precision = 0.0
    rounds = ROUGH_SCALES if rough else LATE_SCALES
    for number, scale in enumerate(rounds):
        if number > 0 or not keep_points:
            state = with_points(state, seen, free_translations=free_translations)
        static = _find_consistent(track_errors(state, seen), scale)
        tracks = np.flatnonzero(static)
        if len(tracks) == 0:
            break
        observed = seen.of_points(tracks)
        prior = LensPrior(expected_focal, _prior_weight(replace(state, points=state.points[tracks]), observed, scale))
        done = adjust(
            replace(state, points=state.points[tracks]), observed, scale=scale, fixed_camera=fixed_camera,
            iterations=MAX_LENS_ITERATIONS if free_distortion else MAX_ITERATIONS, free_focal=free_focal,
            free_translations=free_translations, free_distortion=free_distortion, priors=(prior,),
            tolerance=FINAL_TOLERANCE if scale == LATE_SCALES[-1] else ROUGH_TOLERANCE,
        )  # fmt: skip
        state = _with_others(done.reconstruction, tracks, state.points)
        precision = max(done.focal_precision - prior.weight, 0.0)
        bend_precision = max(done.distortion_precision - prior.weight / USUAL_DISTORTION**2, 0.0)
    tracks = np.flatnonzero(static)
    observed = seen.of_points(tracks)
    if consecutive and free_translations and len(tracks):
        smooth = smooth_path(
            replace(state, points=state.points[tracks]), observed, scale=rounds[-1], fixed_camera=fixed_camera, lens=prior,
            free_focal=free_focal, free_distortion=free_distortion,
        )  # fmt: skip
        state = _with_others(smooth, tracks, state.points)
    error, _ = residuals(replace(state, points=state.points[tracks]), observed)
    # The errors of one track are alike from frame to frame: a track counts as one observation, not as its length.
    variance = float(np.median(error) ** 2) * len(error) / max(len(tracks), 1)
    sigma, bend_sigma = (float(np.sqrt(variance / p)) if p > 0 else float("inf") for p in (precision, bend_precision))
    return Refined(state, static, error, observed.camera, sigma, bend_sigma)


def _find_consistent(errors: np.ndarray, scale: float) -> np.ndarray:
    """Return tracks whose error is within three times that of the better half, or within the scale."""
    finite = errors[np.isfinite(errors)]
    limit = max(scale, 3.0 * float(np.median(finite))) if len(finite) else scale
    return errors <= limit


def _prior_weight(state: Reconstruction, observed: Observations, scale: float) -> float:
    """Weight of the expected focal length: a wrong factor of e costs as much as a twentieth of all residuals.

    Lens distortion and drifting tracks change the cost by about that much, so less is no evidence about the focal length.
    """
    error, _ = residuals(state, observed)
    return 0.05 * scale**2 * float(np.log1p((error / scale) ** 2).sum())
