"""Bodies: unit spheres and unit cubes under affine maps that change with time.

A point of a body keeps its unit coordinates u for ever and stands at x(t) = A(t) u + c(t). That one line covers bodies
that rest, travel, turn and deform, and it makes flow and tracks exact: the point that a ray hits is carried to another
time by its u.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from flowsplat.geometry import Camera
from flowsplat.scenes.synthetic.textures import Material

Shape = Literal["ellipsoid", "box", "room"]

Motion = Callable[[float], tuple[np.ndarray, np.ndarray]]
"""Seconds to (A [3, 3], c [3]), in meters."""


@dataclass(frozen=True)
class Body:
    """One body of the world.

    Attributes:
        shape: an ellipsoid or a box seen from outside, or a room: a box seen from inside.
        size: [3] half extents at rest, in meters; they scale the texture.
        motion: where the body is.
        material: its colors.
        number: its number in the masks; 0 = part of the static world.
    """

    shape: Shape
    size: np.ndarray
    motion: Motion
    material: Material
    number: int = 0

    def carry(self, local: np.ndarray, time: float) -> np.ndarray:
        """Return where the points with unit coordinates [N, 3] are in the world."""
        A, c = self.motion(time)
        return local @ A.T + c

    def intersect(self, origin: np.ndarray, directions: np.ndarray, time: float) -> np.ndarray:
        """Return [N] multiples of ``directions`` [N, 3] at which rays from ``origin`` [3] meet the body; infinite if missed."""
        A, c = self.motion(time)
        inverse = np.linalg.inv(A)
        o, d = inverse @ (origin - c), inverse @ directions.T
        if self.shape == "ellipsoid":
            a, b = (d * d).sum(0), o @ d
            root = b * b - a * (o @ o - 1)
            nearest = (-b - np.sqrt(np.maximum(root, 0))) / a
            return np.where((root > 0) & (nearest > 0), nearest, np.inf)
        step = 1 / np.where(d == 0, 1e-300, d)
        middle, half = -o[:, None] * step, np.abs(step)
        far = (middle + half).min(0)
        if self.shape == "room":
            return far
        near = (middle - half).max(0)
        return np.where((near < far) & (near > 0), near, np.inf)

    def faces(self, local: np.ndarray) -> np.ndarray:
        """Return [N] the faces on which points with unit coordinates [N, 3] lie, counted as ``Surface.face`` does."""
        if self.shape == "ellipsoid":
            return np.zeros(len(local), int)
        axis = np.abs(local).argmax(1)
        return 2 * axis + (local[np.arange(len(local)), axis] > 0)

    def normals(self, local: np.ndarray, time: float) -> np.ndarray:
        """Return [N, 3] unit normals in the world that point to where the body is seen from."""
        if self.shape == "ellipsoid":
            normals = local
        else:
            face = self.faces(local)
            normals = np.eye(3)[face // 2] * np.where(face % 2 == (self.shape != "room"), 1, -1)[:, None]
        world = normals @ np.linalg.inv(self.motion(time)[0])
        return world / np.linalg.norm(world, axis=1, keepdims=True)

    def bounds(self, camera: Camera, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return two corners ([2] pixels each) of a rectangle of the image outside of which the body is never seen."""
        A, c = self.motion(time)
        signs = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)
        corners, depth = camera.project(signs @ A.T + c)
        if (depth < 1e-3).any():
            return np.full(2, -np.inf), np.full(2, np.inf)
        return corners.min(0), corners.max(0)
