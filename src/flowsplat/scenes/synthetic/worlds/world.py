"""A world of objects on a ground: everything that a clip of it shows, and what is true of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import rigid
from flowsplat.scenes.synthetic.ray_cast import Hits, RayCastWorld
from flowsplat.scenes.synthetic.worlds.cameras import CameraKind, Views
from flowsplat.scenes.synthetic.worlds.casting import CAPSULE, ROOM, cast, render
from flowsplat.scenes.synthetic.worlds.ground import WorldGround
from flowsplat.scenes.synthetic.worlds.parts import Placed, WorldObject, WorldPart

MIN_RESTING_FRAMES = 9
"""Frames for which nothing of an object may move for it to count as resting. Chosen by eye."""

_MIN_MOTION = 1e-4
"""Meters a frame below which a part does not move. Chosen by eye."""

_BLUR_EXPOSURES = 6
"""Times over which a blurred image is averaged. Chosen by eye."""

_SAMPLES = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])
"""Pixels."""

_SUN_SIZE = 0.012
"""Radians by which the directions to the sun differ: shadows have soft edges. Chosen by eye."""

_NO_BOUND = 1e9
"""Pixels: the border of what reaches behind the camera, beyond any image."""


@dataclass(frozen=True)
class Light:
    """``direction`` [3] to the sun, its strength, the strength of the sky, both as factors of the colors.

    ``occlusion``: share of the sky's light that what moves takes from what rests right beside it, which is a contact shadow;
    0 = none.
    """

    direction: np.ndarray
    sun: float
    ambient: float
    occlusion: float = 0.0


@dataclass(frozen=True)
class World(RayCastWorld):
    """A world of objects on a ground, before one camera. Same description, same bits.

    Attributes:
        seed: which world it is.
        width: pixels.
        height: pixels.
        frames: how many.
        fps: frames a second.
        ground: what objects stand on.
        camera_kind: how the camera moves.
        focal: focal length in widths of the image.
        path: from times [T] to the cameras.
        static: what never moves: the sky, the boxes of the ground, all else.
        objects: what moves; the first has number 1 in the masks.
        light: sun and sky.
        shutter: share of the time between frames that an image is exposed; 0 = no blur.
        noise: standard deviation of the images' noise in gray levels.
        touching: numbers of two objects that touch each other, if any.
    """

    seed: int
    width: int
    height: int
    frames: int
    fps: float
    ground: WorldGround
    camera_kind: CameraKind
    focal: float
    path: Callable[[np.ndarray], Views]
    static: tuple[Placed, ...]
    objects: tuple[WorldObject, ...]
    light: Light
    shutter: float = 0.0
    noise: float = 0.0
    touching: tuple[int, int] | None = None

    VISIBLE: ClassVar[float] = 1e-5
    LONGEST_FLOW: ClassVar[float] = 500.0

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return (self.frames - 1) / self.fps

    @cached_property
    def parts(self) -> tuple[WorldPart, ...]:
        """All parts, those of the static world first."""
        return (*(placed.part for placed in self.static), *(part for obj in self.objects for part in obj.parts))

    @cached_property
    def numbers(self) -> np.ndarray:
        """[P] uint8 to which object each part belongs, 0 = static."""
        counts = [len(self.static), *(len(obj.parts) for obj in self.objects)]
        return np.repeat(np.arange(len(counts)), counts).astype(np.uint8)

    @property
    def object_count(self) -> int:
        """How many objects there are."""
        return len(self.objects)

    def track_rng(self) -> np.random.Generator:
        """Return a new generator, always the same, that decides which points are tracked."""
        return np.random.default_rng([self.seed, 4])

    @cached_property
    def _constants(self) -> dict[str, np.ndarray]:
        casts = np.array([part.shape != ROOM for part in self.parts])
        casts[1 : 1 + self.ground.boxes] = False  # The ground shades nothing but what is inside it.
        return {
            "shapes": np.array([part.shape for part in self.parts]), "sizes": np.stack([part.size for part in self.parts]),
            "radii": np.array([part.radius for part in self.parts]), "casts": casts,
            "materials": np.stack([part.material for part in self.parts]),
        }  # fmt: skip

    def poses(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return (rotations [P, 3, 3] from the parts' axes to the world's, centers [P, 3])."""
        times = np.array([time])
        moved = [obj.poses(times) for obj in self.objects]
        turns = [np.stack([placed.turn for placed in self.static]), *(R[0] for R, _ in moved)]
        centers = [np.stack([placed.center for placed in self.static]), *(c[0] for _, c in moved)]
        return np.concatenate(turns), np.concatenate(centers)

    def camera_at(self, time: float, width: int | None = None, height: int | None = None) -> Camera:
        """Return the camera at a time in seconds, with another number of pixels if asked for."""
        width, height = width or self.width, height or self.height
        (center,), (R,) = self.path(np.array([time]))
        focal = self.focal * width
        return Camera(rigid(R, -R @ center), np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), width, height)

    def camera(self, i: int) -> Camera:
        """Return the camera of frame ``i``, meters, world z up."""
        return self.camera_at(self.timestamps[i])

    # -- rays

    def _compute_views(self, camera: Camera, turns: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (the camera's center in the parts' axes [P, 3], rectangles [P, 4] outside of which parts are never seen)."""
        origins = np.einsum("pkq,pk->pq", turns, camera.center - centers)
        # Corners of a box round every part in its own axes.
        sizes = self._constants["sizes"].copy()
        tubes = np.isin(self._constants["shapes"], (2,))
        sizes[tubes, 2] += sizes[tubes, 0]
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), -1).reshape(-1, 3)
        corners = centers[:, None] + np.einsum("pkq,psq->psk", turns, signs * sizes[:, None])
        uv, depth = camera.project(corners)
        bounds = np.concatenate([uv.min(1) - 0.01, uv.max(1) + 0.01], 1)
        behind = (depth < 1e-2).any(1) | (self._constants["shapes"] == ROOM)
        bounds[behind] = [-_NO_BOUND, -_NO_BOUND, _NO_BOUND, _NO_BOUND]
        return origins, bounds

    def cast(self, camera: Camera, time: float, uv: np.ndarray) -> Hits:
        """Return what a camera sees at ``time`` at positions ``uv`` [N, 2] (pixels)."""
        turns, centers = self.poses(time)
        origins, bounds = self._compute_views(camera, turns, centers)
        c = self._constants
        uv = np.ascontiguousarray(uv, np.float64)
        R = np.ascontiguousarray(camera.viewmat[:3, :3])
        return Hits(*cast(c["shapes"], c["sizes"], turns, origins, bounds, R, camera.intrinsics, uv))

    def image(self, i: int) -> np.ndarray:
        """Return [H, W, 3] uint8 RGB of frame ``i``: antialiased, blurred by motion and noisy as the world says."""
        return self.photograph(self.camera_at, self.timestamps[i], np.random.default_rng([self.seed, 3, i]))

    def photograph(self, camera_at: Callable[[float], Camera], time: float, rng: np.random.Generator) -> np.ndarray:
        """Return [H, W, 3] uint8 RGB at a time in seconds, as ``image``.

        Args:
            camera_at: from seconds to the camera, which moves while an image is exposed.
            rng: of the noise.
        """
        shares = (np.arange(_BLUR_EXPOSURES) + 0.5) / _BLUR_EXPOSURES - 0.5 if self.shutter else np.zeros(1)
        lights = self._suns()
        for k, share in enumerate(shares):
            moment = time + share * self.shutter / self.fps
            camera = camera_at(moment)
            if k == 0:
                total = np.zeros((camera.height, camera.width, 3))
            turns, centers = self.poses(moment)
            origins, bounds = self._compute_views(camera, turns, centers)
            c = self._constants
            # Of several exposures each takes two of the samples in turn.
            chosen = slice(None) if len(shares) == 1 else slice(k % 2, None, 2)
            render(
                c["shapes"], c["sizes"], turns, centers, origins, bounds, c["radii"], c["casts"], c["materials"],
                np.ascontiguousarray(camera.viewmat[:3, :3]), camera.intrinsics, camera.center, _SAMPLES[chosen], lights[chosen],
                self.light.ambient, self.light.sun, self._occluders(turns, centers), self.light.occlusion, len(self.static), total,
            )  # fmt: skip
        levels = total * (255 / len(shares)) + self.noise * rng.normal(size=total.shape)
        return np.clip(levels + 0.5, 0, 255).astype(np.uint8)

    def _occluders(self, turns: np.ndarray, centers: np.ndarray) -> np.ndarray:
        """Return [Q, 4] centers and radii of balls that fill the parts of objects; long ones are three balls along their longest
        axis."""
        moving, shapes, sizes = self.numbers > 0, self._constants["shapes"], self._constants["sizes"].copy()
        sizes[shapes == CAPSULE, 2] += sizes[shapes == CAPSULE, 0]
        radii = np.cbrt(sizes.prod(1) / 3)
        longest = sizes.argmax(1)
        axes = np.take_along_axis(turns, longest[:, None, None], 2)[..., 0]
        way = axes * np.maximum(sizes.max(1) - radii, 0)[:, None]
        balls = [np.concatenate([centers + k * way, radii[:, None]], 1)[moving] for k in (-1.0, 0.0, 1.0)]
        return np.concatenate(balls)

    def _suns(self) -> np.ndarray:
        """Return [S, 3] directions to points of the sun."""
        axis = self.light.direction
        aside = np.cross(axis, [0.3, 0.5, -0.8])
        aside /= np.linalg.norm(aside)
        suns = axis + _SUN_SIZE * 4 * (_SAMPLES[:, :1] * aside + _SAMPLES[:, 1:] * np.cross(axis, aside))
        return np.asarray(suns / np.linalg.norm(suns, axis=1, keepdims=True))

    # -- truth

    def geometry(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (planar depth [H, W] in meters at the pixel centers, number of the object [H, W] uint8) of frame ``i``."""
        return self.cast_rays(self.camera(i), self.timestamps[i])

    def carry(self, hits: Hits, time: float) -> np.ndarray:
        """Return [N, 3] where the points that were hit are at ``time``."""
        turns, centers = self.poses(time)
        return np.asarray(np.einsum("nkq,nq->nk", turns[hits.part], hits.local) + centers[hits.part])

    def describe(self, number: int) -> dict[str, object]:
        """Return what is true of an object, to be written as JSON.

        Returns:
            ``number``, ``kind``, ``contact`` (seconds at which it touches the ground), ``swings``, ``rolls``, ``rests`` (for
            ``MIN_RESTING_FRAMES`` frames or more), ``pivot`` [3] or None, and ``touches``: the object that it touches, or None.
        """
        obj = self.objects[number - 1]
        times = self.timestamps
        contact = sorted({*times[obj.touching(times)[1].any(1)].tolist(), *obj.instants})
        R, c = obj.poses(times)
        steps = np.abs(np.diff(c, axis=0)).max((1, 2)) + np.abs(np.diff(R, axis=0)).max((1, 2, 3))
        still = np.concatenate([[0], np.cumsum(steps < _MIN_MOTION)])
        pair = self.touching
        other = None if pair is None or number not in pair else pair[0] + pair[1] - number
        return {
            "number": number, "kind": obj.kind, "contact": [round(t, 6) for t in contact], "swings": obj.swings,
            "rolls": obj.rolls, "rests": bool((still[MIN_RESTING_FRAMES - 1 :] - still[: -MIN_RESTING_FRAMES + 1] >=
            MIN_RESTING_FRAMES - 1).any()),
            "pivot": None if obj.pivot is None else [round(float(x), 6) for x in obj.pivot], "touches": other,
        }  # fmt: skip
