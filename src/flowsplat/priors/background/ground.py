"""The ground: planes with an extent, and what height is left over on them, found once for a clip from its static depth.

A mover that stands on the ground is where its feet are, and the depth beside its feet is the least sure of all: masks and
shadows spoil it. So the ground is fitted to what all frames saw of it. Which way is up is not known; cameras are held
upright within ``TILT``, and the ground lies below them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from flowsplat.geometry import Camera

TILT = 35.0
"""Degrees between the ground's normal and the mean upward direction of the cameras."""
TOLERANCE = 0.012
"""Share of a point's depth that it may lie off a plane."""
SHARPNESS = 0.3
"""Tolerances off a plane at which a point counts half."""
BELOW = 1.0
"""How much a point that lies below a plane speaks against it, where one on it speaks for it: nothing is below the ground."""
FEWEST_SHARE = 0.04
"""Share of all static points from which a plane is one."""
MOST_LEVELS = 3
"""Planes at most: steps and terraces."""
SAME_TILT = 12.0
"""Degrees between the normals of levels."""
NEIGHBOURS = 24
"""Points of a level around a place whose median height is that of the ground there."""
REACH = 0.12
"""How far from a place, in units of its distance, a point still tells of it."""
_SAMPLES, _TRIES, _REFITS = 6000, 2000, 5


@dataclass(frozen=True)
class _Level:
    """One plane: points X with normal . X = offset, and the points that lie on it, as seen from above."""

    normal: np.ndarray
    offset: float
    axes: np.ndarray
    heights: np.ndarray
    tree: cKDTree

    def along(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays [N, 3] from ``origin`` meet it, in lengths of a ray (inf: nowhere), and whether points were seen there."""
        fall = rays @ self.normal
        above = origin @ self.normal - self.offset
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(fall * np.sign(above) < -1e-9, -above / fall, np.inf)
        known = np.zeros(len(rays), bool)
        for _ in range(2):
            hit = np.isfinite(t)
            if not hit.any():
                break
            places = (origin + t[hit, None] * rays[hit]) @ self.axes.T
            reach = REACH * t[hit] * np.linalg.norm(rays[hit], axis=1)
            count = min(NEIGHBOURS, len(self.heights))
            away, index = self.tree.query(places, k=count, workers=1)
            away, index = away.reshape(len(places), -1), index.reshape(len(places), -1)
            near = away <= reach[:, None]
            heights = np.where(near, self.heights[index], np.nan)
            enough = near.sum(1) >= max(3, count // 3)
            height = np.zeros(len(places))
            height[enough] = np.nanmedian(heights[enough], axis=1)
            known[hit] = enough
            t[hit] = (height - above) / fall[hit]
        return np.where(t > 0, t, np.inf), known


@dataclass(frozen=True)
class Ground:
    """What one can stand on.

    Attributes:
        levels: the largest first.
        share: of the static points that lie on it.
    """

    levels: tuple[_Level, ...]
    share: float

    @property
    def normal(self) -> np.ndarray:
        """[3] unit vector, up, of the largest level."""
        return self.levels[0].normal

    def height(self, points: np.ndarray) -> np.ndarray:
        """[N] how far points [N, 3] are above the largest level."""
        return points @ self.normal - self.levels[0].offset

    def depth(self, camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Planar depth [N] at which the rays through pixels [N, 2] meet the ground (inf: nowhere), and where it was seen."""
        rays = camera.unproject(pixels, np.ones(len(pixels))) - camera.center
        depth, known = self.levels[0].along(camera.center, rays)
        for level in self.levels[1:]:
            other, seen = level.along(camera.center, rays)
            # Only the largest level goes on where nobody saw it. What is nearer and was seen hides what is farther.
            better = seen & ((other < depth) | ~known)
            depth, known = np.where(better, other, depth), known | better
        return depth, known


def up_direction(cameras: Sequence[Camera]) -> np.ndarray:
    """[3] unit vector: the mean direction of the tops of the pictures."""
    up = -np.mean([camera.viewmat[1, :3] for camera in cameras], 0)
    return up / np.linalg.norm(up)


def find_ground(points: np.ndarray, depths: np.ndarray, cameras: Sequence[Camera], seed: int = 0) -> Ground | None:
    """The ground among static points.

    Args:
        points: [N, 3] world.
        depths: [N] depth of each in the frame that saw it: its error grows with it.
        cameras: of the frames.
        seed: of the random choices.

    Returns:
        None where no plane below the cameras holds ``FEWEST_SHARE`` of the points.
    """
    rng = np.random.default_rng(seed)
    if len(points) > _SAMPLES:
        chosen = rng.choice(len(points), _SAMPLES, replace=False)
        points, depths = points[chosen], depths[chosen]
    up = up_direction(cameras)
    centers = np.array([camera.center for camera in cameras])
    total, levels, on_ground = len(points), [], 0
    axis, tilt = up, TILT
    free = np.ones(len(points), bool)
    while len(levels) < MOST_LEVELS and free.sum() >= max(30, FEWEST_SHARE * total):
        found = _plane(points[free], depths[free], points, depths, centers, axis, tilt, rng, first=not levels)
        if found is None:
            break
        normal, offset = found
        off = points @ normal - offset
        on = free & (np.abs(off) < 3 * TOLERANCE * depths)
        near = free & (np.abs(off) < TOLERANCE * depths)
        if near.sum() < FEWEST_SHARE * total:
            break
        side = np.linalg.svd(normal[None])[2][1:]
        levels.append(_Level(normal, offset, side, off[on], cKDTree(points[on] @ side.T)))
        on_ground += int(near.sum())
        free &= ~on
        axis, tilt = levels[0].normal, SAME_TILT
    return Ground(tuple(levels), on_ground / total) if levels else None


def _plane(
    points: np.ndarray, depths: np.ndarray, everything: np.ndarray, all_depths: np.ndarray, centers: np.ndarray, axis: np.ndarray,
    tilt: float, rng: np.random.Generator, first: bool,
) -> tuple[np.ndarray, float] | None:  # fmt: skip
    """The plane that most points lie on and few below: (normal, offset)."""
    corners = points[rng.integers(0, len(points), (_TRIES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 1e-12] / lengths[lengths > 1e-12, None]
    offsets = (normals * corners[lengths > 1e-12, 0]).sum(1)
    flip = np.sign(normals @ axis)
    normals, offsets = normals * flip[:, None], offsets * flip
    possible = (normals @ axis > np.cos(np.radians(tilt))) & ((centers @ normals.T).min(0) > offsets)
    normals, offsets = normals[possible], offsets[possible]
    if len(normals) == 0:
        return None
    off = (points @ normals.T - offsets) / (TOLERANCE * depths[:, None])
    # Points right on a plane count most: one that passes between two levels has many near it, but few on it.
    on = ((np.abs(off) < 1) / (1 + (off / SHARPNESS) ** 2)).sum(0)
    if first:
        on = on - BELOW * (off < -3).sum(0)
    best = int(np.argmax(on))
    normal, offset = normals[best], float(offsets[best])
    for _ in range(_REFITS):
        near = np.abs(points @ normal - offset) < TOLERANCE * depths
        if near.sum() < 10:
            return None
        off_plane = (points[near] @ normal - offset) / (TOLERANCE * depths[near])
        weights = 1 / (depths[near] ** 2 * (1 + (off_plane / SHARPNESS) ** 2))
        middle = np.average(points[near], axis=0, weights=weights)
        spread = ((points[near] - middle) * weights[:, None]).T @ (points[near] - middle)
        fitted = np.linalg.eigh(spread)[1][:, 0]
        normal = fitted * np.sign(fitted @ axis)
        offset = float(normal @ middle)
    return normal, offset


def static_points(
    depths: Sequence[np.ndarray], sure: Sequence[np.ndarray], cameras: Sequence[Camera], every: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] and depths [N] of sure static pixels of some frames, thinned.

    Args:
        depths: [h, w] planar each.
        sure: bool [h, w] each; a pixel next to one that is not is left out.
        cameras: of these frames at that size.
    """
    points, found = [], []
    for depth, trusted, camera in zip(depths, sure, cameras, strict=True):
        inner = cv2.erode(trusted.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        y, x = np.nonzero(inner[::every, ::every])
        y, x = y * every, x * every
        z = depth[y, x].astype(np.float64)
        points.append(camera.unproject(np.stack([x, y], 1) + 0.5, z))
        found.append(z)
    return np.concatenate(points), np.concatenate(found)
