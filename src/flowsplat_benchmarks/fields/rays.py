"""Turn the training frames of a prepared scene into rays with the colors that they should have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.scenes import Scene

DEPTH_SHARES = (0.01, 0.99)
"""Quantiles of the trusted depths, between which the scene lies but for what is wrong of them. Chosen by eye."""
DEPTH_MARGIN = 1.5
"""Times which the field goes beyond them, on both ends: held-out frames may show more. Chosen by eye."""
SAMPLED_PIXELS = 17
"""Every how many pixels the depth of one is looked at."""


@dataclass(frozen=True)
class Rays:
    """Rays in normalized coordinates.

    Attributes:
        origins: [N, 3] float32.
        directions: [N, 3] float32, of planar depth 1.
        times: [N] float32 of the clip, 0 to 1.
    """

    origins: Tensor
    directions: Tensor
    times: Tensor

    def __len__(self) -> int:
        return len(self.times)

    def part(self, start: int, end: int) -> Rays:
        """Return those from ``start`` to before ``end``."""
        return Rays(self.origins[start:end], self.directions[start:end], self.times[start:end])


def cast_rays(camera: Camera, time: float) -> Rays:
    """Return a ray through the center of every pixel, row by row.

    Args:
        camera: in normalized coordinates.
        time: of the clip, 0 to 1.
    """
    pixels = pixel_grid(camera.width, camera.height).reshape(-1, 2)
    directions = camera.unproject(pixels, np.ones(len(pixels))) - camera.center
    origins = np.broadcast_to(camera.center, directions.shape)
    times = torch.full((len(pixels),), time, dtype=torch.float32)
    return Rays(torch.tensor(origins, dtype=torch.float32), torch.tensor(directions, dtype=torch.float32), times)


@dataclass(frozen=True)
class TrainingRays:
    """All pixels of the training frames that show the scene.

    Attributes:
        rays: N of them.
        colors: [N, 3] float32 sRGB, 0 to 1.
        near, far: planar depths in normalized coordinates, between which the scene is.
        frame_times: of the training frames, rising, 0 to 1.
    """

    rays: Rays
    colors: Tensor
    near: float
    far: float
    frame_times: tuple[float, ...]

    def draw(self, count: int, generator: torch.Generator) -> tuple[Rays, Tensor]:
        """Return ``count`` rays at random, and their colors [count, 3]."""
        chosen = torch.randint(len(self.rays), (count,), generator=generator)
        rays = self.rays
        return Rays(rays.origins[chosen], rays.directions[chosen], rays.times[chosen]), self.colors[chosen]


def load_rays(scene: Scene) -> TrainingRays:
    """Return the rays of the training frames of a scene; held-out frames are not looked at.

    Raises:
        InputError: cameras or depth are missing, or all of the image is burnt in.
    """
    near, far = find_bounds(scene)
    similarity, cameras, times, overlay = scene.similarity, scene.cameras, scene.times, scene.overlay
    seen = torch.ones(scene.height * scene.width, dtype=torch.bool) if overlay is None else torch.tensor(~overlay.ravel())
    if not seen.any():
        raise InputError(f"{scene.folder} has frames of which nothing shows the scene: all of their pixels are burnt in.")
    found, colors = [], []
    for i in scene.train_frames:
        every = cast_rays(similarity.camera(cameras[i]), float(times[i]))
        found.append(Rays(every.origins[seen], every.directions[seen], every.times[seen]))
        colors.append(torch.tensor(scene.frame(i)).reshape(-1, 3)[seen].float() / 255)
    origins, directions, when = (torch.cat([getattr(each, name) for each in found]) for name in ("origins", "directions", "times"))
    return TrainingRays(
        Rays(origins, directions, when), torch.cat(colors), near, far, tuple(float(times[i]) for i in scene.train_frames)
    )


def find_bounds(scene: Scene) -> tuple[float, float]:
    """Return the planar depths between which a scene is, in normalized coordinates, from its depth of the training frames.

    Raises:
        InputError: the scene has no depth, or none above 0.
    """
    if not all(scene.has_depth(i) for i in scene.train_frames):
        raise InputError(f"{scene.folder} has no depth: prepare it first, with flowsplat prepare.")
    depths = [scene.depth(i) for i in scene.train_frames]
    values = np.concatenate([each.depth[each.trusted][::SAMPLED_PIXELS] for each in depths])
    if not len(values):
        values = np.concatenate([each.depth.ravel()[::SAMPLED_PIXELS] for each in depths])
    values = values[np.isfinite(values) & (values > 0)]
    if not len(values):
        raise InputError(f"{scene.folder} has no depth above 0 in its training frames: prepare it anew.")
    low, high = np.quantile(values, DEPTH_SHARES) * scene.similarity.scale
    return float(low / DEPTH_MARGIN), float(high * DEPTH_MARGIN)
