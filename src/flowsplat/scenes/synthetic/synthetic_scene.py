"""The synthetic clip: a small moving world, ray cast, in which everything is known exactly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.scenes.scene import HeldoutView
from flowsplat.scenes.synthetic.bodies import Body
from flowsplat.scenes.synthetic.drawn_clip import DrawnView, views_aside
from flowsplat.scenes.synthetic.ray_cast import Hits, RayCastWorld
from flowsplat.scenes.synthetic.textures import Surface, in_chunks
from flowsplat.scenes.synthetic.world import SCENE_DEPTH, build_world, camera_at

SAMPLES_PER_SIDE = 2
"""Color samples along each side of a pixel. Chosen by eye."""

LIGHT = np.array([-0.45, -0.65, 0.62])
"""Direction to the light, of length 1 within rounding."""


@dataclass(frozen=True)
class SyntheticScene(RayCastWorld):
    """A room with three objects: 1 = a spinning block, 2 = a ball on a circle, 3 = an ellipsoid that deforms.

    Everything moves in seconds: fewer or more frames show less or more of the same motion. Same parameters, same bits.

    Attributes:
        width: pixels.
        height: pixels.
        frames: how many.
        fps: frames a second.
        seed: decides the textures and which points are tracked.

    Raises:
        InputError: a parameter that makes no clip.
    """

    width: int = 320
    height: int = 180
    frames: int = 40
    fps: float = 24.0
    seed: int = 0

    VISIBLE: ClassVar[float] = 1e-6

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 16:
            raise InputError(f"A synthetic clip of {self.width}x{self.height} pixels is too small: use at least 16x16.")
        if self.frames < 2 or not 0 < self.fps < np.inf:
            raise InputError(
                f"A synthetic clip of {self.frames} frame(s) at {self.fps} frames a second shows no motion: "
                "use at least 2 frames and a finite rate above 0."
            )

    @cached_property
    def bodies(self) -> list[Body]:
        """Everything there is, the room first."""
        return build_world(self.seed)

    @cached_property
    def numbers(self) -> np.ndarray:
        """[P] uint8 which object each body is, 0 = static."""
        return np.array([body.number for body in self.bodies], np.uint8)

    @property
    def object_count(self) -> int:
        """How many objects there are."""
        return int(self.numbers.max())

    def track_rng(self) -> np.random.Generator:
        """Return a new generator, always the same, that decides which points are tracked."""
        return np.random.default_rng(self.seed)

    def camera(self, i: int) -> Camera:
        """Return the camera of frame ``i``, meters, world z up."""
        return camera_at(self.timestamps[i], self.width, self.height)

    # -- images

    def cast(self, camera: Camera, time: float, uv: np.ndarray) -> Hits:
        """Return what the camera sees at ``time`` (seconds) at the positions ``uv`` [N, 2] (pixels)."""
        rays = np.ones((len(uv), 3))
        rays[:, :2] = (uv - camera.K[:2, 2]) / [camera.K[0, 0], camera.K[1, 1]]
        # Directions of planar depth 1: the multiple of them that meets a surface is its depth.
        directions = rays @ camera.viewmat[:3, :3]
        u, v = uv.T
        depth, index = np.full(len(uv), np.inf), np.zeros(len(uv), np.int64)
        for k, body in enumerate(self.bodies):
            (left, top), (right, bottom) = body.bounds(camera, time)
            near = np.flatnonzero((u >= left) & (u <= right) & (v >= top) & (v <= bottom))
            found = body.intersect(camera.center, directions[near], time)
            closer = found < depth[near]
            depth[near[closer]], index[near[closer]] = found[closer], k
        points, local = camera.center + depth[:, None] * directions, np.empty_like(directions)
        for k, body in enumerate(self.bodies):
            A, c = body.motion(time)
            local[index == k] = (points[index == k] - c) @ np.linalg.inv(A).T
        return Hits(depth, index, local)

    def render(self, camera: Camera, time: float) -> DrawnView:
        """Return the world at ``time`` (seconds) from any camera inside the room."""
        offsets = (np.arange(SAMPLES_PER_SIDE) - (SAMPLES_PER_SIDE - 1) / 2) / SAMPLES_PER_SIDE
        grid = pixel_grid(camera.width, camera.height).astype(np.float64).reshape(-1, 2)
        color = np.zeros((len(grid), 3))
        for x in offsets:
            for y in offsets:
                color += self._shade(camera, time, self.cast(camera, time, grid + [x, y]))
        image = np.clip(color * (255 / SAMPLES_PER_SIDE**2) + 0.5, 0, 255).astype(np.uint8)
        return DrawnView(image.reshape(camera.height, camera.width, 3), *self.cast_rays(camera, time))

    def _shade(self, camera: Camera, time: float, hits: Hits) -> np.ndarray:
        """Return [N, 3] display values between 0 and 1: texture, one distant light, and fixed shade where static things meet."""
        color = np.empty((len(hits.depth), 3))
        for k, body in enumerate(self.bodies):
            chosen = hits.part == k
            if not chosen.any():
                continue
            local, points = hits.local[chosen], body.carry(hits.local[chosen], time)
            normals = body.normals(local, time)
            gaze = camera.center - points
            cosine = np.abs(np.einsum("nk,nk->n", normals, gaze)) / np.linalg.norm(gaze, axis=1)
            footprint = hits.depth[chosen] / camera.K[0, 0] / np.sqrt(np.maximum(cosine, 0.05))
            albedo = in_chunks(body.material, Surface(local * body.size, body.faces(local), footprint))
            light = 0.84 + 0.26 * normals @ LIGHT
            if body.number == 0:
                light *= self._openness(points, normals, k)
            color[chosen] = np.clip(albedo * light[:, None], 0, 1)
        return color

    def _openness(self, points: np.ndarray, normals: np.ndarray, own: int) -> np.ndarray:
        """Return [N] how much of the sky static bodies leave to points [N, 3] of body ``own``, 0 to 1.

        Bodies count as spheres (https://iquilezles.org/articles/sphereao/), and the room darkens towards its edges.
        """
        room = self.bodies[0]
        gaps = room.size - np.abs(points - room.motion(0.0)[1])
        crease = 1 - 0.35 * np.exp(-gaps / 0.35)
        open_share = crease[:, 0] * crease[:, 1] * crease[:, 2] * (1 if own else 1 / 0.65)
        for k, body in enumerate(self.bodies[1:], 1):
            if body.number or k == own:
                continue
            away = body.motion(0.0)[1] - points
            squared = np.einsum("nk,nk->n", away, away)
            facing = np.maximum(np.einsum("nk,nk->n", away, normals), 0) / np.sqrt(squared)
            open_share *= 1 - facing * np.minimum((1.2 * body.size.mean()) ** 2 / squared, 0.9)
        return open_share

    def carry(self, hits: Hits, time: float) -> np.ndarray:
        """Return [N, 3] where the points that were hit are at ``time``."""
        points = np.empty_like(hits.local)
        for k, body in enumerate(self.bodies):
            points[hits.part == k] = body.carry(hits.local[hits.part == k], time)
        return points

    def heldout_views(self) -> list[HeldoutView]:
        """Return a camera to the left and one to the right of the clip's own, at every fourth frame."""
        return views_aside(self.camera, self.frames, SCENE_DEPTH)
