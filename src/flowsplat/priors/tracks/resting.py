"""Points that rest: where cameras and depth say that they are, also while nothing of them was found.

What is no object moves as the cameras do. So a followed point of the background has one unknown, its distance, and what was
found of it over the clip tells that far better than each frame alone where the point is. Once it is known, the point's path
is, too, through every gap. A point whose path fits no distance slipped, or is on something that moves, and is not believed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowsplat.geometry import Camera
from flowsplat.priors.continuity import Continuity
from flowsplat.scenes import Scene

MAX_PATH_ERROR = 1.5
"""Pixels from the path of a resting point up to which it was found there, and within which depth leads back to its birth.
Chosen by eye."""
MIN_ON_PATH = 2
"""Frames in which a resting point must have been found on its path. Chosen by eye."""
MIN_ON_PATH_SHARE = 0.6
"""The same as a share of the frames in which it was found at all. Chosen by eye."""
DEPTH_ERROR, MAX_DEPTH_ERROR = 0.03, 0.15
"""Relative error of the inverse depth to be expected, and that from which a point is not what its pixel shows. Chosen by eye."""
RESIDUAL_SCALE = 0.5
"""Pixels: a sample that is this far off the path has half its weight (Cauchy). Chosen by eye."""
MIN_RESTING_POINTS = 0.5
"""Share of the background's points that must rest; with fewer it is the cameras that are not believed. Chosen by eye."""
SUPPOSED_CONFIDENCE = 0.6
"""Confidence of a point that was not found where it must be seen. Chosen by eye."""
_REWEIGHTING_ROUNDS = 10
"""Rounds of reweighting of a resting point's path. Chosen by eye."""


@dataclass(frozen=True)
class _Rays:
    """Of points [N]: where their first cameras stand and where these see them, [N, 3] each, at planar depth 1."""

    origins: np.ndarray
    directions: np.ndarray

    def project(
        self, cameras: Sequence[Camera], frames: np.ndarray, rows: np.ndarray, inverse: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels [K, 2] of points ``rows`` [K] at ``inverse`` depth [K] in ``frames`` [K], and their derivatives [K, 2] by
        it.

        Not finite behind the camera.
        """
        R, t = (np.stack([camera.viewmat[:3, part] for camera in cameras])[frames] for part in (slice(3), 3))
        focal, middle = (np.stack([camera.K[[0, 1], part] for camera in cameras])[frames] for part in ([0, 1], [2, 2]))
        A = np.einsum("kij,kj->ki", R, self.directions[rows])
        B = np.einsum("kij,kj->ki", R, self.origins[rows]) + t
        place = A + inverse[:, None] * B
        z = np.where(place[:, 2:] > 1e-6, place[:, 2:], np.nan)
        at = place[:, :2] / z
        return at * focal + middle, (B[:, :2] - at * B[:, 2:]) / z * focal


def complete_resting(scene: Scene, points: np.ndarray, confidence: np.ndarray, births: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give points of the background the paths of resting points; those without one are given up, but for their births.

    Without cameras, masks and depth, or where hardly anything rests by them, all stays as it is.

    Args:
        points: [P, T, 2] pixels, undefined where the confidence is 0.
        confidence: [P, T] between 0 and 1; above 0 where a point was found.
        births: [P] the frame in which each one was surely there.

    Returns:
        points and confidence, anew.
    """
    if any(scene.prior(name) is None for name in ("cameras", "masks", "depth")):
        return points, confidence
    inverse, moving = _at_births(scene, points, births)
    rows = np.flatnonzero(~moving)
    if len(rows) == 0:
        return points, confidence
    cameras, first = scene.cameras, births[rows]
    ahead = np.stack([cameras[i].unproject(points[n, i], np.ones(())) for n, i in zip(rows, first, strict=True)])
    centers = np.stack([camera.center for camera in cameras])[first]
    rays = _Rays(centers, ahead - centers)
    found = confidence[rows] > 0
    found[np.arange(len(rows)), first] = False
    fitted, agrees = _fit(rays, cameras, points[rows], found, inverse[rows])
    counts = agrees.sum(1)
    rests = (
        (counts >= MIN_ON_PATH)
        & (counts >= MIN_ON_PATH_SHARE * found.sum(1))
        & (np.abs(np.log(fitted / inverse[rows])) <= MAX_DEPTH_ERROR)
    )
    lasting = found.sum(1) >= MIN_ON_PATH
    if rests.sum() <= MIN_RESTING_POINTS * lasting.sum():
        return points, confidence
    points, confidence = points.copy(), confidence.copy()
    sure = confidence[rows, first]
    confidence[rows] = np.where(agrees & rests[:, None], confidence[rows], 0)
    confidence[rows, first] = sure
    _fill(scene, rays, rows, first, rests, fitted, points, confidence)
    return points, confidence


def _at_births(scene: Scene, points: np.ndarray, births: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return inverse depth [P] of the pixels at which points are born, and whether objects are there [P]."""
    inverse, moving = np.ones(len(points)), np.zeros(len(points), bool)
    for i in np.unique(births):
        born = np.flatnonzero(births == i)
        x, y = np.clip(points[born, i].astype(int), 0, [scene.width - 1, scene.height - 1]).T
        inverse[born], moving[born] = 1 / scene.depth(i).depth[y, x], scene.mask(i)[y, x] > 0
    return inverse, moving


def _fit(
    rays: _Rays, cameras: Sequence[Camera], points: np.ndarray, found: np.ndarray, inverse: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inverse depth [N] at which what was found [N, T] lies on most, and what then does [N, T]: robust Gauss-Newton."""
    rows, frames = np.nonzero(found)
    seen, count = points[rows, frames], len(inverse)
    stiffness = 1 / (DEPTH_ERROR * inverse) ** 2
    fitted = inverse.copy()
    for _ in range(_REWEIGHTING_ROUNDS):
        place, change = rays.project(cameras, frames, rows, fitted[rows])
        off = np.nan_to_num(place - seen, nan=1e6)
        weight = 1 / (1 + (off**2).sum(1) / RESIDUAL_SCALE**2)
        change = np.nan_to_num(change)
        slope = np.bincount(rows, weight * (change * off).sum(1), count) + stiffness * (fitted - inverse)
        curvature = np.bincount(rows, weight * (change**2).sum(1), count) + stiffness
        fitted = np.clip(fitted - slope / curvature, inverse / 2, inverse * 2)
    agrees = np.zeros(found.shape, bool)
    place, _ = rays.project(cameras, frames, rows, fitted[rows])
    agrees[rows, frames] = np.linalg.norm(place - seen, axis=1) < MAX_PATH_ERROR
    return fitted, agrees


def _fill(
    scene: Scene, rays: _Rays, rows: np.ndarray, first: np.ndarray, rests: np.ndarray, fitted: np.ndarray,
    points: np.ndarray, confidence: np.ndarray,
) -> None:  # fmt: skip
    """Put resting points where they were not found but must be seen: nothing moves there, and depth leads back to the birth."""
    cameras, continuity, size = scene.cameras, Continuity(scene), (scene.width, scene.height)
    place_of = {i: k for k, i in enumerate(scene.train_frames)}
    piece = continuity.pieces[[place_of[i] for i in first]]
    born = points[rows, first]
    for i, k in place_of.items():
        if continuity.is_blank(k):
            continue
        lost = np.flatnonzero(rests & (confidence[rows, i] == 0) & (piece == continuity.pieces[k]))
        pixels, _ = rays.project(cameras, np.full(len(lost), i), lost, fitted[lost])
        inside = (np.isfinite(pixels) & (pixels >= 0) & (pixels < size)).all(1)
        lost, pixels = lost[inside], pixels[inside]
        x, y = pixels.astype(int).T
        world = cameras[i].unproject(pixels, scene.depth(i).depth[y, x].astype(np.float64))
        back = np.full((len(lost), 2), np.inf)
        for j in np.unique(first[lost]):
            there = first[lost] == j
            back[there] = cameras[j].project(world[there])[0]
        seen = (scene.mask(i)[y, x] == 0) & (np.linalg.norm(back - born[lost], axis=1) < MAX_PATH_ERROR)
        points[rows[lost[seen]], i], confidence[rows[lost[seen]], i] = pixels[seen], SUPPOSED_CONFIDENCE
