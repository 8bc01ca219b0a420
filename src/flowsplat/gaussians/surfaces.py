"""Pixels with depth as discs on the surface that they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from flowsplat.gaussians.observations import Observation
from flowsplat.geometry.rotations import rotations_to_quats


@dataclass(frozen=True)
class SurfaceSamples:
    """Points with a shape: means [N, 3], quats [N, 4], scales [N, 3] and colors [N, 3] in 0..1."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    colors: np.ndarray

    @staticmethod
    def empty() -> SurfaceSamples:
        """No sample."""
        return SurfaceSamples(np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros((0, 3)))

    def select(self, rows: np.ndarray) -> SurfaceSamples:
        """Return some of them."""
        return SurfaceSamples(self.means[rows], self.quats[rows], self.scales[rows], self.colors[rows])

    @staticmethod
    def concatenate(parts: Sequence[SurfaceSamples]) -> SurfaceSamples:
        """Return all samples of several."""
        names = ("means", "quats", "scales", "colors")
        return SurfaceSamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def camera_normals(frame: Observation, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return [N, 3] unit normals of pixels in camera axes, towards the camera.

    Differences over two pixels of smoothed depth, on each axis to the side where depth jumps less, so that edges of objects
    keep the normal of their own surface.

    Args:
        frame: the training frame.
        x: [N] column of each pixel.
        y: [N] row of each pixel.
    """
    depth = cv2.bilateralFilter(frame.depth, 5, 0.02, 2.0)
    height, width = depth.shape
    K, step, far = frame.camera.K, 2, 1e4

    def point(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        rays = (np.stack([x, y], 1) + 0.5 - K[:2, 2]) / [K[0, 0], K[1, 1]]
        z = depth[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)][:, None]
        return np.where(inside[:, None], np.concatenate([rays * z, z], 1), far)

    points = point(x, y)

    def difference(after: np.ndarray, before: np.ndarray) -> np.ndarray:
        ahead, behind = after - points, points - before
        return np.where(np.abs(ahead[:, 2:]) < np.abs(behind[:, 2:]), ahead, behind)

    dx = difference(point(x + step, y), point(x - step, y))
    dy = difference(point(x, y + step), point(x, y - step))
    normals = np.cross(dx, dy)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    views = points / np.linalg.norm(points, axis=1, keepdims=True)
    normals = np.where(length > 1e-12, normals / np.maximum(length, 1e-12), -views)
    facing = (normals * views).sum(1, keepdims=True)
    return np.where(facing > 0, -normals, normals)


def sample_surface(frame: Observation, wanted: np.ndarray, size: float | np.ndarray, flatness: float) -> SurfaceSamples:
    """Return one disc for every wanted pixel [H, W].

    Args:
        frame: the training frame.
        wanted: which pixels.
        size: radius in pixels, as a standard deviation: one number, or [H, W].
        flatness: thickness relative to the radius.

    The third axis is the normal. A tilted disc is stretched along its tilt, at most three times, so that it covers as many
    pixels as one that faces the camera.
    """
    y, x = np.nonzero(wanted)
    depth = frame.depth[y, x].astype(np.float64)
    rotation = frame.camera.viewmat[:3, :3]
    means = frame.camera.unproject(np.stack([x, y], 1) + 0.5, depth)
    normals = camera_normals(frame, x, y) @ rotation
    rays = means - frame.camera.center
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    cosine = -(rays * normals).sum(1, keepdims=True)
    tilt = rays + cosine * normals
    tilt_length = np.linalg.norm(tilt, axis=1, keepdims=True)
    axis = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    anywhere = np.cross(axis, normals)
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    tilted = tilt_length > 0.05
    first = np.where(tilted, tilt / np.maximum(tilt_length, 1e-9), anywhere)
    frames = np.stack([first, np.cross(normals, first), normals], -1)
    radius = (size[y, x] if isinstance(size, np.ndarray) else size) * depth / frame.camera.K[0, 0]
    stretch = np.where(tilted[:, 0], 1 / np.maximum(cosine[:, 0], 1 / 3), 1.0)
    scales = np.stack([radius * stretch, radius, radius * flatness], 1)
    quats = rotations_to_quats(torch.from_numpy(frames)).numpy()
    return SurfaceSamples(means, quats, scales, frame.image[y, x] / 255.0)
