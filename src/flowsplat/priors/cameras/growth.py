"""Grow a reconstruction from two frames to all of them: triangulate, add the frame that sees the most, adjust, and again."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.common.kernels import kernel
from flowsplat.priors.cameras.bundle import LensPrior, Reconstruction, adjust, rays, residuals
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.twoview import Pair, intrinsics, relative_pose

MIN_POINTS = 10
"""Triangulated points that a frame must see to be placed. Chosen by eye."""


@dataclass
class Model:
    """A reconstruction under way.

    Attributes:
        state: poses of all frames (meaningless where not ``placed``) and one point a track.
        placed: [T] bool.
        solid: [N] bool, tracks with a point to rely on.
        origin: the frame that defines the world.
    """

    state: Reconstruction
    placed: np.ndarray
    solid: np.ndarray
    origin: int


def triangulate(state: Reconstruction, seen: Observations) -> np.ndarray:
    """Return points [N, 3] by linear triangulation from all that saw them, in pixels from the principal point."""
    matrices = np.concatenate([state.rotations, state.translations[:, :, None]], 2)
    directions = rays(seen.uv, state.focal, state.distortion)
    h = np.linalg.eigh(_normal_equations(matrices, directions, seen.camera, seen.point, seen.points))[1][:, :, 0]
    return h[:, :3] / np.where(np.abs(h[:, 3:]) < 1e-9, 1e-9, h[:, 3:])


@kernel
def _normal_equations(matrices, directions, camera, point, count):
    """[count, 4, 4] of the homogeneous points, from projections [T, 3, 4] and directions [M, 2]."""
    normal = np.zeros((count, 4, 4))
    row = np.zeros(4)
    for m in range(len(point)):
        P, n = matrices[camera[m]], point[m]
        for k in range(2):
            for i in range(4):
                row[i] = directions[m, k] * P[2, i] - P[k, i]
            for i in range(4):
                for j in range(4):
                    normal[n, i, j] += row[i] * row[j]
    return normal


def ray_angles(state: Reconstruction, points: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return [N] radians between the rays from the first and the last camera that see a point."""
    first = seen.argmax(1)
    last = seen.shape[1] - 1 - seen[:, ::-1].argmax(1)
    a, b = points - state.centers[first], points - state.centers[last]
    cosine = (a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-12)
    return np.arccos(np.clip(cosine, -1, 1))


def renew_points(model: Model, positions: np.ndarray, seen: np.ndarray, limit: float) -> None:
    """Triangulate every track anew and judge which points are solid: seen twice, reprojecting within ``limit``, with parallax."""
    views = seen & model.placed
    state = model.state
    observed = Observations.of(positions, views)
    points = triangulate(state, observed)
    state = Reconstruction(state.rotations, state.translations, state.focal, points)
    error, depth = residuals(state, observed)
    bad = np.bincount(observed.point, (error > limit) | (depth <= 1e-3), len(points))
    counts = views.sum(1)
    model.state = state
    model.solid = (counts >= 2) & (bad <= 0.3 * counts) & (ray_angles(state, points, views) > np.radians(0.4))
    model.solid &= np.isfinite(points).all(1)


def adjust_model(
    model: Model,
    positions: np.ndarray,
    seen: np.ndarray,
    *,
    iterations: int,
    scale: float,
    free_focal: bool,
    prior: LensPrior | None,
) -> float:
    """Bundle-adjust the placed frames and solid points in place; the mean robust cost an observation in square pixels."""
    frames, tracks = np.flatnonzero(model.placed), np.flatnonzero(model.solid)
    state = model.state
    part = Reconstruction(state.rotations[frames], state.translations[frames], state.focal, state.points[tracks])
    views = seen[np.ix_(tracks, frames)]
    if not views.any():
        return np.inf
    done = adjust(
        part,
        Observations.of(positions[np.ix_(tracks, frames)], views),
        iterations=iterations,
        scale=scale,
        fixed_camera=int(np.searchsorted(frames, model.origin)),
        free_focal=free_focal,
        priors=() if prior is None else (prior,),
    )
    rotations, translations, points = (x.copy() for x in (state.rotations, state.translations, state.points))
    found = done.reconstruction
    rotations[frames], translations[frames], points[tracks] = found.rotations, found.translations, found.points
    model.state = Reconstruction(rotations, translations, found.focal, points)
    return done.cost / int(views.sum())


def grow(
    positions: np.ndarray,
    seen: np.ndarray,
    pair: Pair,
    focal: float,
    *,
    prior: LensPrior | None,
    free_focal: bool,
) -> Model | None:
    """Place frame after frame, beginning with ``pair``; frames that see too little stay out.

    Args:
        positions: [N, T, 2] pixels from the principal point.
        seen: [N, T].

    Returns:
        the model, or None where the pair gives no start.
    """
    count = positions.shape[1]
    start = relative_pose(positions, seen, pair, focal)
    if start is None:
        return None
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    rotations[pair.j], translations[pair.j] = start
    placed = np.zeros(count, bool)
    placed[[pair.i, pair.j]] = True
    state = Reconstruction(rotations, translations, focal, np.zeros((len(positions), 3)))
    model = Model(state, placed, np.zeros(len(positions), bool), pair.i)
    renew_points(model, positions, seen, 3.0)
    adjust_model(model, positions, seen, iterations=10, scale=1.0, free_focal=False, prior=None)
    renew_points(model, positions, seen, 3.0)
    refused = np.zeros(count, bool)
    while (frame := _next_frame(model, seen, refused)) is not None:
        if not _place(model, positions, seen, frame):
            refused[frame] = True
            continue
        refused[:] = False
        number = int(model.placed.sum())
        renew_points(model, positions, seen, 3.0)
        if number < 6 or number % 6 == 0:
            focal_now = free_focal and number >= 12
            adjust_model(model, positions, seen, iterations=4, scale=1.0, free_focal=focal_now, prior=prior)
            renew_points(model, positions, seen, 3.0)
    return model


def _next_frame(model: Model, seen: np.ndarray, refused: np.ndarray) -> int | None:
    """Return the frame that sees the most solid points, next to a placed or refused one; None where none sees enough."""
    known = np.pad(model.placed | refused, 1)
    beside = known[:-2] | known[2:]
    counts = (seen & model.solid[:, None]).sum(0) * (beside & ~known[1:-1])
    best = int(counts.argmax())
    return best if counts[best] >= MIN_POINTS else None


def _place(model: Model, positions: np.ndarray, seen: np.ndarray, frame: int) -> bool:
    """Pose of ``frame`` from the points it sees; False where they do not agree on one."""
    state = model.state
    tracks = np.flatnonzero(seen[:, frame] & model.solid)
    others = np.flatnonzero(model.placed)
    near = others[np.abs(others - frame).argmin()]
    K = intrinsics(state.focal)
    points, pixels = state.points[tracks], positions[tracks, frame].astype(np.float64)
    rotation, _ = cv2.Rodrigues(state.rotations[near])
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points, pixels, K, None, rotation.copy(), state.translations[near][:, None].copy(), True, 200, 3.0, 0.999,
        flags=cv2.SOLVEPNP_ITERATIVE,
    )  # fmt: skip
    if not found or inliers is None or len(inliers) < MIN_POINTS:
        return False
    chosen = inliers[:, 0]
    rotation, translation = cv2.solvePnPRefineLM(points[chosen], pixels[chosen], K, None, rotation, translation)
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return False
    rotations, translations = state.rotations.copy(), state.translations.copy()
    rotations[frame], translations[frame] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    model.state = Reconstruction(rotations, translations, state.focal, state.points)
    model.placed[frame] = True
    return True
