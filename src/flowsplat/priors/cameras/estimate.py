"""Which camera model the tracks support (moving, turning, standing still), and the best cameras of that kind."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from flowsplat.common.progress import progress_bar
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath
from flowsplat.priors.cameras.bundle import FocalPrior, Reconstruction
from flowsplat.priors.cameras.growth import Model, grow, ray_angles
from flowsplat.priors.cameras.refinement import Refined, misfit, ray_points, refine
from flowsplat.priors.cameras.selection import choose_tracks
from flowsplat.priors.cameras.twoview import chained_rotations, rank_pairs

USUAL_FOCAL = 0.9
"""Focal length over width that is expected before looking: about 58 degrees across."""
START_FOCALS = (0.9, 0.6, 1.5)
"""Focal lengths over width from which the search starts."""
SUCCESSES = 3
"""Complete reconstructions after which the search ends."""
SIMPLER = 1.25
"""A simpler kind of motion is believed unless a richer one lowers the misfit by more than this factor."""
NEGLIGIBLE = 0.04
"""A misfit that errors of a tenth of a pixel cause: below it no richer motion is tried."""
MOST_STARTS = 15
"""Attempts at a reconstruction, whatever comes of them."""
LEAST_TRACKS = 8
"""Tracks below which nothing can be said about the camera."""


@dataclass(frozen=True)
class Estimate:
    """Cameras for all frames.

    Attributes:
        motion: ``free``, ``rotation`` (it only turns), ``static``, or ``unknown`` where nothing could be followed.
        fit: the cameras with what speaks for them.
        unplaced: frames that saw too few tracks; their poses are interpolated.
        breaks: frames that share hardly a track with the frame before them.
        parallax: radians between the first and the last ray to a static point, the median of the longer half of tracks.
    """

    motion: str
    fit: Refined
    unplaced: list[int]
    breaks: list[int]
    parallax: float


def estimate(positions: np.ndarray, width: float, height: float, focal: float | None) -> Estimate:
    """Find the cameras behind tracks.

    Args:
        positions: [N, T, 2] pixels of the frames, NaN where not seen.
        focal: pixels, where it is known.
    """
    seen = np.isfinite(positions[..., 0])
    centred = np.where(seen[..., None], positions, 0).astype(np.float64) - [width / 2, height / 2]
    breaks = (1 + np.flatnonzero((seen[:, 1:] & seen[:, :-1]).sum(0) < LEAST_TRACKS)).tolist()
    few = choose_tracks(positions, seen, width, height, per_cell=4, shortest=2)
    expected, free_focal = focal or USUAL_FOCAL * width, focal is None
    tracks, views = centred[few], seen[few]
    standing = _standing(centred, seen, expected)
    if len(few) < LEAST_TRACKS:
        return Estimate("unknown", standing, [], breaks, 0.0)
    starts = {"static": _Candidate(misfit(standing.state, tracks, views, free_translations=False), standing.state, [], 0)}
    if starts["static"].misfit > NEGLIGIBLE:
        starts["rotation"] = turning = _turning(tracks, views, expected, free_focal)
        if turning.misfit > NEGLIGIBLE:
            starts["free"] = _search(tracks, views, width, expected, free_focal, turning.state)
    enough = SIMPLER * (min(start.misfit for start in starts.values()) + NEGLIGIBLE)
    motion, start = next((kind, start) for kind, start in starts.items() if start.misfit + NEGLIGIBLE <= enough)
    if motion == "static":
        return Estimate("static", standing, [], breaks, 0.0)
    many = choose_tracks(positions, seen, width, height, per_cell=20)
    many = many if len(many) > len(few) else few
    fit = refine(
        start.state, centred[many], seen[many], fixed_camera=start.origin, expected_focal=expected,
        free_focal=free_focal, free_translations=motion == "free",
    )  # fmt: skip
    parallax = _parallax(fit, seen[many]) if motion == "free" else 0.0
    return Estimate(motion, fit, start.unplaced, breaks, parallax)


def _parallax(fit: Refined, seen: np.ndarray) -> float:
    lengths = seen.sum(1) * fit.static
    longer = np.flatnonzero(lengths >= max(2, np.median(lengths[fit.static])))
    return float(np.median(ray_angles(fit.state, fit.state.points[longer], seen[longer])))


def _standing(centred: np.ndarray, seen: np.ndarray, focal: float) -> Refined:
    """All cameras at the origin, every track at its mean position."""
    count = seen.shape[1]
    state = Reconstruction(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), focal, np.zeros((len(seen), 3)))
    weights = seen[..., None] / np.maximum(seen.sum(1), 1)[:, None, None]
    distance = np.linalg.norm(centred - (centred * weights).sum(1, keepdims=True), axis=-1)
    longer = seen & (seen.sum(1) >= 2)[:, None]
    errors = distance[longer] if longer.any() else np.zeros(1)
    frames = np.nonzero(longer)[1] if longer.any() else np.zeros(1, int)
    return Refined(state, np.asarray(seen.any(1)), errors, frames, float("inf"))


@dataclass(frozen=True)
class _Candidate:
    """One of several reconstructions: how badly it fits, the cameras, frames without a place, and the fixed frame."""

    misfit: float
    state: Reconstruction
    unplaced: list[int]
    origin: int


def _turning(centred: np.ndarray, seen: np.ndarray, expected: float, free_focal: bool) -> _Candidate:
    """Cameras in one place that only turn."""
    count = seen.shape[1]
    rotations = chained_rotations(centred, seen, expected)
    state = Reconstruction(rotations, np.zeros((count, 3)), expected, np.zeros((len(seen), 3)))
    fit = refine(state, centred, seen, fixed_camera=0, expected_focal=expected, free_focal=free_focal, free_translations=False)
    return _Candidate(misfit(fit.state, centred, seen, free_translations=False), fit.state, [], 0)


def _search(
    centred: np.ndarray, seen: np.ndarray, width: float, expected: float, free_focal: bool, turning: Reconstruction
) -> _Candidate:
    """The best of several reconstructions from different pairs of frames and focal lengths.

    A narrow and a wide lens can explain a distant, shallow scene almost equally well from one start; which is right
    shows only after each was adjusted, so several are. One starts from the cameras that only turn, with all points at
    the same distance: where the camera hardly leaves its place, no pair of frames has parallax to start from.
    """
    focals = [factor * width for factor in START_FOCALS] if free_focal else [expected]
    known = partial(refine, expected_focal=expected, free_focal=free_focal)
    on_sphere = replace(turning, points=ray_points(turning, centred, seen))
    fit = known(on_sphere, centred, seen, fixed_camera=0, keep_points=True)
    found = [_Candidate(misfit(fit.state, centred, seen), fit.state, [], 0)]
    starts = list(product(rank_pairs(centred, seen, expected), focals))[:MOST_STARTS]
    prior = FocalPrior(expected, 20.0) if free_focal else None
    with progress_bar("Camera search", len(starts)) as bar:
        for pair, focal in starts:
            bar.advance()
            model = grow(centred, seen, pair, focal, prior=prior, free_focal=free_focal)
            if model is not None and model.solid.sum() >= 0.3 * len(seen):
                fit = known(_with_all_frames(model), centred, seen, fixed_camera=model.origin)
                unplaced = np.flatnonzero(~model.placed).tolist()
                found.append(_Candidate(misfit(fit.state, centred, seen), fit.state, unplaced, model.origin))
                if sum(not candidate.unplaced for candidate in found) > SUCCESSES:
                    break
    return min(found, key=lambda candidate: candidate.misfit)


def _with_all_frames(model: Model) -> Reconstruction:
    """Poses of frames that were not placed, interpolated between those that were."""
    state, placed = model.state, np.flatnonzero(model.placed)
    if len(placed) == len(model.placed):
        return state
    cameras = []
    for t in placed:
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = state.rotations[t], state.translations[t]
        cameras.append(Camera(viewmat, np.eye(3), 1, 1))
    path = CameraPath(placed.tolist(), cameras)
    viewmats = np.array([path.at(t).viewmat for t in range(len(model.placed))])
    return replace(state, rotations=viewmats[:, :3, :3], translations=viewmats[:, :3, 3])
