"""Which points were seen where: a list as long as what was seen, since most points are seen in few of a long clip's frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np


@dataclass(frozen=True)
class Observations:
    """Which camera saw which point where, ordered by point and then by camera.

    A camera here is a frame, and a point a track of what was followed.

    Attributes:
        camera: [M] int64.
        point: [M] int64, not falling.
        uv: [M, 2] pixels: from the corner of the image as they are followed, from the principal point where cameras are computed.
        points: how many points there are, N; some may not be seen at all.
        cameras: how many cameras there are, T.
    """

    camera: np.ndarray
    point: np.ndarray
    uv: np.ndarray
    points: int
    cameras: int

    @staticmethod
    def of(positions: np.ndarray, seen: np.ndarray | None = None) -> Observations:
        """From positions [N, T, 2] and which of them count [N, T]: those that are no NaN, where that is not said."""
        seen = np.isfinite(positions[..., 0]) if seen is None else seen
        point, camera = map(np.ascontiguousarray, np.nonzero(seen))
        return Observations(camera, point, positions[point, camera], *seen.shape)

    def __len__(self) -> int:
        return len(self.point)

    @cached_property
    def counts(self) -> np.ndarray:
        """[N] how many cameras saw each point."""
        return np.bincount(self.point, minlength=self.points)

    @cached_property
    def first(self) -> np.ndarray:
        """[N + 1] where the observations of each point begin."""
        return np.concatenate([[0], np.cumsum(self.counts)])

    @cached_property
    def seen(self) -> np.ndarray:
        """[N, T] bool which camera saw which point."""
        seen = np.zeros((self.points, self.cameras), bool)
        seen[self.point, self.camera] = True
        return seen

    def dense(self, missing: float = np.nan) -> np.ndarray:
        """Return positions [N, T, 2], with a value where a point was not seen."""
        positions = np.full((self.points, self.cameras, 2), missing, self.uv.dtype)
        positions[self.point, self.camera] = self.uv
        return positions

    def where(self, kept: np.ndarray) -> Observations:
        """Return the observations that are ``kept`` [M] bool; points and cameras keep their numbers."""
        return replace(self, camera=self.camera[kept], point=self.point[kept], uv=self.uv[kept])

    def of_points(self, points: np.ndarray) -> Observations:
        """Return those of some points, rising indices or [N] bool, which are numbered anew."""
        points = np.flatnonzero(points) if points.dtype == bool else points
        number = np.full(self.points, -1)
        number[points] = np.arange(len(points))
        kept = self.where(number[self.point] >= 0)
        return replace(kept, point=number[kept.point], points=len(points))

    def of_cameras(self, cameras: np.ndarray) -> Observations:
        """Return those of some cameras, rising indices, which are numbered anew."""
        number = np.full(self.cameras, -1)
        number[cameras] = np.arange(len(cameras))
        kept = self.where(number[self.camera] >= 0)
        return replace(kept, camera=number[kept.camera], cameras=len(cameras))

    def at(self, uv: np.ndarray) -> Observations:
        """Return the same with other places [M, 2]; what is NaN there was not seen."""
        return replace(self, uv=uv).where(np.isfinite(uv[:, 0]))

    def from_middle(self, width: float, height: float) -> Observations:
        """Return the same with places as float64 from the middle of images of this size."""
        return replace(self, uv=self.uv.astype(np.float64) - [width / 2, height / 2])

    def by_camera(self) -> list[np.ndarray]:
        """Return for each camera the indices of its observations, in the order of their points."""
        order = np.argsort(self.camera, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.camera, minlength=self.cameras))[:-1])
