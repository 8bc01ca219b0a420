"""The ground: a map of heights over a plane, found once for a piece of a clip from its static depth.

An object that stands on the ground is where its feet are, and the depth beside its feet is the least sure of all: masks and
shadows spoil it. So the ground is what all frames saw of it: static points of surfaces that face up. Which way is up is not
known; cameras are held upright within ``MAX_NORMAL_TILT``, and the ground lies below them. Steps and slopes are in the map; where
nothing of the ground was seen near a place, it is not known there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import unproject_depth

MAX_NORMAL_TILT = 35.0
"""Degrees between the ground's normal and the mean upward direction of the cameras (docs/method/objects.md)."""
MAX_SLOPE = 35.0
"""Degrees by which a surface may slope and still be ground. Chosen by eye."""
PLANE_TOLERANCE = 0.012
"""Share of a point's depth that it may lie off a plane. Chosen by eye."""
PLANE_HALF_WEIGHT = 0.3
"""Tolerances off a plane at which a point counts half. Chosen by eye."""
BELOW_PLANE_WEIGHT = 1.0
"""How much a point that lies below a plane speaks against it, where one on it speaks for it: nothing is below the ground.
Chosen by eye."""
MIN_GROUND_SHARE = 0.03
"""Share of all static points from which there is a ground. Chosen by eye."""
MIN_PLANE_SHARE = 0.5
"""Share of what faces up that must lie near the plane for it to be taken on where nothing was seen: steps and terraces end.
Chosen by eye."""
CELL_SIZE = 0.015
"""Side of a cell of the map, in units of the median depth of its points (docs/method/objects.md)."""
MAX_CARRY_CELLS = 8
"""Cells across which heights are carried to where nothing was seen: what an object always hides (docs/method/objects.md)."""
HEIGHT_PERCENTILE = 40
"""Percentile of the heights in a cell that counts: what stands on the ground is above it. Chosen by eye."""
_PLANE_SAMPLES, _PLANE_TRIES, _PLANE_REFITS = 4000, 1500, 5
"""Points that judge a plane, planes that are tried, and rounds in which the best is fitted anew. Chosen by eye."""
_MAX_MAP_SIDE = 1500
"""Cells of a side of the map, at most, for the memory: cells grow beyond. Chosen by eye."""


@dataclass(frozen=True)
class Ground:
    """What one can stand on.

    Attributes:
        normal: [3] unit vector, up.
        share: of the static points that face up those that lie near the plane.
        origin: [3] a point of the plane; ``axes`` [2, 3] span it.
        corner: [2] of the map, in the plane; ``cell`` the side of its cells.
        heights: [rows, columns] of the ground above the plane, NaN where it is not known.
    """

    normal: np.ndarray
    share: float
    origin: np.ndarray
    axes: np.ndarray
    corner: np.ndarray
    cell: float
    heights: np.ndarray

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return [N] how far points [N, 3] are above the ground right below them; NaN where that is not known."""
        return (points - self.origin) @ self.normal - self._below(points)

    def depth(self, camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return planar depth [N] at which the rays through pixels [N, 2] first meet the ground, and whether it was seen there [N].

        Where it was not, the plane goes on, if most of what faces up lies on it (``MIN_PLANE_SHARE``); inf elsewhere and above the
        horizon.
        """
        seen = self._compute_depth(camera, pixels)
        known = np.isfinite(seen)
        if self.share < MIN_PLANE_SHARE or known.all():
            return seen, known
        rays = camera.unproject(pixels, np.ones(len(pixels))) - camera.center
        fall, above = rays @ self.normal, (camera.center - self.origin) @ self.normal
        with np.errstate(divide="ignore"):
            plane = np.where((fall < -1e-6) & (above > 0), -above / fall, np.inf)
        return np.where(known, seen, plane), known

    def _compute_depth(self, camera: Camera, pixels: np.ndarray) -> np.ndarray:
        origin, rays = camera.center, camera.unproject(pixels, np.ones(len(pixels))) - camera.center
        result = np.full(len(pixels), np.inf)
        if len(pixels) == 0:
            return result
        known = self.heights[np.isfinite(self.heights)]
        above = (origin - self.origin) @ self.normal
        fall = rays @ self.normal
        falling = fall < -1e-6
        if not falling.any() or len(known) == 0:
            return result
        # Between the highest and the lowest ground a ray is followed in steps of half a cell.
        first = np.maximum((known.max() - above) / fall[falling], 0)
        last = (known.min() - 1e-9 - above) / fall[falling]
        flat = np.linalg.norm(rays[falling] @ self.axes.T, axis=1)
        extent = self.cell * float(np.hypot(*self.heights.shape)) + np.linalg.norm((origin - self.origin) @ self.axes.T)
        last = np.minimum(last, 2 * extent / np.maximum(flat, 1e-9)) + self.cell / np.maximum(flat, 1e-9)
        steps = int(np.clip(np.ceil(((last - first) * flat).max() / (0.5 * self.cell)), 2, 800))
        t = first[:, None] + (last - first)[:, None] * np.linspace(0, 1, steps)
        gap = self.height((origin + t[..., None] * rays[falling, None]).reshape(-1, 3)).reshape(t.shape)
        crossed = (gap[:, :-1] > 0) & (gap[:, 1:] <= 0)
        row = np.flatnonzero(crossed.any(1))
        at = crossed[row].argmax(1)
        high, low = gap[row, at], gap[row, at + 1]
        meets = t[row, at] + (t[row, at + 1] - t[row, at]) * high / np.maximum(high - low, 1e-12)
        result[np.flatnonzero(falling)[row]] = meets
        return result

    def _below(self, points: np.ndarray) -> np.ndarray:
        """Return [N] height of the ground above the plane below or above points [N, 3], between cells linearly where it is even."""
        place = ((points - self.origin) @ self.axes.T - self.corner) / self.cell - 0.5
        # A row of pixels may be longer than OpenCV allows: 1,024 at a time.
        width = 1024
        padded = np.full((-(-len(place) // width) * width, 2), -9.0, np.float32)
        padded[: len(place)] = np.clip(place, -9, 1e6)
        x, y = (padded[:, axis].reshape(-1, width) for axis in (0, 1))
        found = cv2.remap(
            self.heights, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan")
        )  # fmt: skip
        return found.ravel()[: len(place)].astype(np.float64)


def up_direction(cameras: Sequence[Camera]) -> np.ndarray:
    """Return [3] unit vector: the mean direction of the tops of the images."""
    up = -np.mean([camera.viewmat[1, :3] for camera in cameras], 0)
    return up / np.linalg.norm(up)


def find_ground(
    points: np.ndarray, normals: np.ndarray, depths: np.ndarray, cameras: Sequence[Camera], seed: int = 0
) -> Ground | None:
    """Return the ground among static points.

    Args:
        points: [N, 3] world.
        normals: [N, 3] unit vectors of their surfaces, towards the camera that saw them.
        depths: [N] depth of each in the frame that saw it: its error grows with it.
        cameras: of the frames.
        seed: of the random choices.

    Returns:
        None where hardly any surface below the cameras faces up.
    """
    rng = np.random.default_rng(seed)
    up, total = up_direction(cameras), len(points)
    facing = normals @ up > np.cos(np.radians(MAX_NORMAL_TILT + MAX_SLOPE) / 1.4)
    if facing.sum() < max(30, MIN_GROUND_SHARE * total):
        return None
    flat, far = points[facing], depths[facing]
    few = rng.choice(len(flat), min(_PLANE_SAMPLES, len(flat)), replace=False)
    found = _plane(flat[few], far[few], np.array([c.center for c in cameras]), up, rng)
    if found is None:
        return None
    normal, offset = found
    upward = normals @ normal > np.cos(np.radians(MAX_SLOPE))
    near = upward & (np.abs(points @ normal - offset) < 2 * PLANE_TOLERANCE * depths)
    if near.sum() < max(30, MIN_GROUND_SHARE * total):
        return None
    share = float(near.sum() / upward.sum())
    axes = np.linalg.svd(normal[None])[2][1:]
    axes[1] *= np.sign(np.cross(axes[0], axes[1]) @ normal)
    origin = normal * offset
    kept = points[upward & (points @ normal < min(float(c.center @ normal) for c in cameras))]
    return _build_map(kept, normal, share, origin, axes, CELL_SIZE * float(np.median(depths[upward])))


def _build_map(
    points: np.ndarray, normal: np.ndarray, share: float, origin: np.ndarray, axes: np.ndarray, cell: float
) -> Ground | None:
    """Return the map of the points [N, 3] that face up."""
    places, heights = (points - origin) @ axes.T, (points - origin) @ normal
    if len(places) == 0:
        return None
    # Few points far away must not make the map endless.
    low, high = np.percentile(places, [0.5, 99.5], axis=0)
    cell = max(cell, float((high - low).max()) / _MAX_MAP_SIDE)
    corner = low - (MAX_CARRY_CELLS + 1) * cell
    shape = (np.ceil((high - corner) / cell).astype(int) + MAX_CARRY_CELLS + 1)[::-1]
    index = np.floor((places - corner) / cell).astype(int)
    inside = ((index >= 0) & (index < shape[::-1])).all(1)
    flat, values = index[inside, 1] * shape[1] + index[inside, 0], heights[inside]
    order = np.lexsort((values, flat))
    flat, values = flat[order], values[order]
    cells, first, counts = np.unique(flat, return_index=True, return_counts=True)
    grid = np.full(shape[0] * shape[1], np.nan, np.float32)
    grid[cells] = values[first + (counts * HEIGHT_PERCENTILE) // 100]
    grid = _smooth(grid.reshape(shape))
    away, nearest = distance_transform_edt(np.isnan(grid), return_indices=True)
    grid = np.where(away <= MAX_CARRY_CELLS, grid[tuple(nearest)], np.nan)
    return Ground(normal, share, origin, axes, corner, cell, grid.astype(np.float32))


def _smooth(grid: np.ndarray) -> np.ndarray:
    """Return the median of each known cell and its known neighbors; a cell alone is dropped."""
    padded = np.pad(grid, 1, constant_values=np.nan)
    around = np.stack([padded[y : y + grid.shape[0], x : x + grid.shape[1]] for y in range(3) for x in range(3)])
    enough = np.isfinite(around).sum(0) >= 3
    result = np.full(grid.shape, np.nan, np.float32)
    result[enough] = np.nanmedian(around[:, enough], axis=0)
    return np.where(np.isfinite(grid), result, np.nan)


def _plane(
    points: np.ndarray, depths: np.ndarray, centers: np.ndarray, axis: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, float] | None:
    """Return the plane that most points lie on and few below: (normal, offset)."""
    corners = points[rng.integers(0, len(points), (_PLANE_TRIES, 3))]
    found = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(found, axis=1)
    found = found[lengths > 1e-12] / lengths[lengths > 1e-12, None]
    offsets = (found * corners[lengths > 1e-12, 0]).sum(1)
    flip = np.sign(found @ axis)
    found, offsets = found * flip[:, None], offsets * flip
    possible = (found @ axis > np.cos(np.radians(MAX_NORMAL_TILT))) & ((centers @ found.T).min(0) > offsets)
    found, offsets = found[possible], offsets[possible]
    if len(found) == 0:
        return None
    off = (points @ found.T - offsets) / (PLANE_TOLERANCE * depths[:, None])
    # Points right on a plane count most: one that passes between two levels has many near it, but few on it.
    on = ((np.abs(off) < 1) / (1 + (off / PLANE_HALF_WEIGHT) ** 2)).sum(0) - BELOW_PLANE_WEIGHT * (off < -3).sum(0)
    best = int(np.argmax(on))
    normal, offset = found[best], float(offsets[best])
    for _ in range(_PLANE_REFITS):
        near = np.abs(points @ normal - offset) < PLANE_TOLERANCE * depths
        if near.sum() < 10:
            return None
        off_plane = (points[near] @ normal - offset) / (PLANE_TOLERANCE * depths[near])
        weights = 1 / (depths[near] ** 2 * (1 + (off_plane / PLANE_HALF_WEIGHT) ** 2))
        middle = np.average(points[near], axis=0, weights=weights)
        spread = ((points[near] - middle) * weights[:, None]).T @ (points[near] - middle)
        fitted = np.linalg.eigh(spread)[1][:, 0]
        normal = fitted * np.sign(fitted @ axis)
        offset = float(normal @ middle)
    return normal, offset


def static_points(
    depths: Sequence[np.ndarray], sure: Sequence[np.ndarray], cameras: Sequence[Camera], every: int = 2
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points [N, 3] of sure static pixels of some frames, thinned, unit normals [N, 3] of their surfaces, and depths [N].

    Args:
        depths: [h, w] planar each.
        sure: bool [h, w] each; a pixel next to one that is not is left out.
        cameras: of these frames at that size.
    """
    points, normals, found = [], [], []
    for depth, trusted, camera in zip(depths, sure, cameras, strict=True):
        # Normals of a window: those of neighboring pixels are lost in the noise.
        world = unproject_depth(cv2.blur(depth.astype(np.float64), (3, 3)), camera)
        right, down = np.zeros_like(world), np.zeros_like(world)
        right[:, 2:-2], down[2:-2] = world[:, 4:] - world[:, :-4], world[4:] - world[:-4]
        normal = np.cross(down, right)
        length = np.linalg.norm(normal, axis=-1)
        inner = (cv2.erode(trusted.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0) & (length > 1e-12)
        inner[:2], inner[-2:], inner[:, :2], inner[:, -2:] = False, False, False, False
        y, x = np.nonzero(inner[::every, ::every])
        y, x = y * every, x * every
        z = depth[y, x].astype(np.float64)
        points.append(camera.unproject(np.stack([x, y], 1) + 0.5, z))
        towards = normal[y, x] / length[y, x, None]
        normals.append(towards * -np.sign(((points[-1] - camera.center) * towards).sum(1, keepdims=True)))
        found.append(z)
    return np.concatenate(points), np.concatenate(normals), np.concatenate(found)
