"""The truth of a world of which it is known what every ray meets: depth, objects, flow, tracks, and what two cameras both see."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from flowsplat.common.spread import spread
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.scenes.layers import Flow, Tracks
from flowsplat.scenes.scene import HeldoutView

TRACKS_PER_OBJECT = 100
"""True tracks on each object; the static world gets twice as many. Chosen by eye."""

TRACK_BIRTH_FRAMES = 5
"""Frames whose pixels become true tracks. Chosen by eye."""


@dataclass(frozen=True)
class Hits:
    """What rays meet first: planar ``depth`` [N], ``part`` [N] (index), and ``local`` [N, 3], the place on it in its own axes."""

    depth: np.ndarray
    part: np.ndarray
    local: np.ndarray


class RayCastWorld(ABC):
    """A clip of a world that casts rays; what is true of it follows from that. Meters, seconds, world z up.

    Attributes:
        width: pixels.
        height: pixels.
        frames: how many.
        fps: frames a second.
    """

    width: int
    height: int
    frames: int
    fps: float

    VISIBLE: ClassVar[float]
    """A point is seen when the first surface on its ray is not nearer than it by more than this share of its depth."""

    LONGEST_FLOW: ClassVar[float] = np.inf
    """Pixels beyond which flow is cut off, in both directions of both axes."""

    @property
    def timestamps(self) -> np.ndarray:
        """[T] float64 seconds."""
        return np.arange(self.frames) / self.fps

    @property
    @abstractmethod
    def object_count(self) -> int:
        """How many objects there are; the first has number 1."""

    @property
    @abstractmethod
    def numbers(self) -> np.ndarray:
        """[P] uint8 to which object each part belongs, 0 = static."""

    @abstractmethod
    def camera(self, i: int) -> Camera:
        """Return the camera of frame ``i``."""

    @abstractmethod
    def cast(self, camera: Camera, time: float, uv: np.ndarray) -> Hits:
        """Return what a camera sees at ``time`` (seconds) at positions ``uv`` [N, 2] (pixels)."""

    @abstractmethod
    def carry(self, hits: Hits, time: float) -> np.ndarray:
        """Return [N, 3] where the points that were hit are at ``time``."""

    @abstractmethod
    def track_rng(self) -> np.random.Generator:
        """Return a new generator, always the same, that decides which points are tracked."""

    def cast_pixels(self, camera: Camera, time: float) -> Hits:
        """Return what a camera sees at the centers of its pixels, row by row."""
        return self.cast(camera, time, pixel_grid(camera.width, camera.height).astype(np.float64).reshape(-1, 2))

    def cast_rays(self, camera: Camera, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return (planar depth [H, W] in meters, number of the object [H, W] uint8) at the pixel centers of any camera."""
        hits = self.cast_pixels(camera, time)
        shape = (camera.height, camera.width)
        return hits.depth.reshape(shape), self.numbers[hits.part].reshape(shape)

    def sees(self, camera: Camera, time: float, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels [N, 2] of world points [N, 3], and whether the camera sees them [N]: in the image and not hidden."""
        uv, depth = camera.project(points)
        inside = (depth > 0) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
        visible = inside.copy()
        visible[inside] = self.cast(camera, time, uv[inside]).depth >= depth[inside] * (1 - self.VISIBLE)
        return uv, visible

    def flow(self, i: int, j: int) -> Flow:
        """Return the flow from frame ``i`` to frame ``j``; its confidence is 1 where the point is visible in ``j``, else 0."""
        grid = pixel_grid(self.width, self.height).astype(np.float64)
        time = self.timestamps[j]
        uv, visible = self.sees(self.camera(j), time, self.carry(self.cast_pixels(self.camera(i), self.timestamps[i]), time))
        flow = np.clip(uv.reshape(grid.shape) - grid, -self.LONGEST_FLOW, self.LONGEST_FLOW)
        return Flow(i, j, flow.astype(np.float32), visible.reshape(grid.shape[:2]).astype(np.float32))

    def tracks(self) -> Tracks:
        """Return world points over the whole clip, a hundred on each object and twice as many on what rests."""
        return self.tracks_and_owners()[0]

    def tracks_and_owners(self) -> tuple[Tracks, np.ndarray]:
        """Return world points over the whole clip, and the object of each [P], 0 = static.

        ``TRACKS_PER_OBJECT`` on each object, fewer where it hardly shows, and twice as many on the static world: random pixels of
        ``TRACK_BIRTH_FRAMES`` frames, so that each is visible at least once.
        """
        rng = self.track_rng()
        seen = [self.cast_pixels(self.camera(i), self.timestamps[i]) for i in spread(self.frames, TRACK_BIRTH_FRAMES)]
        part, local = np.concatenate([h.part for h in seen]), np.concatenate([h.local for h in seen])
        owners = self.numbers[part]
        chosen = []
        for number in range(self.object_count + 1):
            candidates = np.flatnonzero(owners == number)
            count = min(len(candidates), TRACKS_PER_OBJECT * (1 if number else 2))
            chosen.append(rng.choice(candidates, count, replace=False))
        pick = np.concatenate(chosen)
        points = np.empty((len(pick), self.frames, 3), np.float32)
        visible = np.empty((len(pick), self.frames), bool)
        start = Hits(np.empty(0), part[pick], local[pick])
        for i, time in enumerate(self.timestamps):
            points[:, i] = world = self.carry(start, time)
            visible[:, i] = self.sees(self.camera(i), time, world)[1]
        return Tracks(points, visible, visible.astype(np.float32), owners[pick] > 0), owners[pick]

    def covisible(self, view: HeldoutView) -> np.ndarray:
        """Return [H, W] bool: pixels of a held-out view whose point the clip's frame of the same time sees, too."""
        camera, time = view.camera, self.timestamps[view.frame]
        points = self.carry(self.cast_pixels(camera, time), time)
        return self.sees(self.camera(view.frame), time, points)[1].reshape(camera.height, camera.width)
