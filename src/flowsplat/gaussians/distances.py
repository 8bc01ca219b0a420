"""Objects nearer or farther than they were trained: the one thing about an object that no image of the clip tells.

An object whose places and sizes are multiplied by one number k about the center of the clip's camera, at every time about where the
camera is at that time, looks the same in all of the clip's own frames except for which object covers which:

    X' = C(t) + k (X - C(t))

So its distance can be chosen after training, exactly. C(t) follows the clip's path between its frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flowsplat.common.errors import InputError
from flowsplat.gaussians.gaussians4d import Active, Gaussians4D
from flowsplat.gaussians.slicing import Slice, slice_gaussians
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath
from flowsplat.splatting.rules import EPS2D

MIN_FACTOR, MAX_FACTOR = 0.1, 10.0
"""The smallest and the largest factor: what lies beyond is a slip of whoever typed it. Chosen by eye."""
_SPEED_TIME_STEP = 1e-4
"""Of clip time, to tell how fast the camera goes."""


@dataclass(frozen=True)
class Distances:
    """How many times as far away as they were trained some objects are.

    Attributes:
        factors: the number k of each of them.
        path: the clip's cameras by clip time, in the normalized coordinates of the Gaussians.
    """

    factors: Mapping[int, float]
    path: CameraPath

    def center(self, t: float) -> np.ndarray:
        """Return [3] C(t), where the clip's camera is at clip time ``t``."""
        return self.path.at(t).center

    def compute_speed(self, t: float) -> np.ndarray:
        """Return [3] how far C(t) goes per clip length; 0 before and after the clip, where it stands."""
        before, after = np.clip([t - _SPEED_TIME_STEP, t + _SPEED_TIME_STEP], self.path.times[0], self.path.times[-1])
        return (self.center(after) - self.center(before)) / (after - before) if after > before else np.zeros(3)

    def move(self, points: Tensor, object_ids: Tensor, t: float) -> Tensor:
        """Return where points [N, 3] of the objects with these numbers [N] are at clip time ``t``."""
        scale = torch.ones(len(points), dtype=points.dtype, device=points.device)
        for number, factor in self.factors.items():
            scale[object_ids == number] = factor
        center = torch.as_tensor(self.center(t), dtype=points.dtype, device=points.device)
        return center + scale[:, None] * (points - center)


def check_factors(factors: Mapping[int, float]) -> None:
    """Refuse what is no factor of a distance.

    Raises:
        InputError: one is not a number between ``MIN_FACTOR`` and ``MAX_FACTOR``.
    """
    for number, factor in factors.items():
        if not (math.isfinite(factor) and MIN_FACTOR <= factor <= MAX_FACTOR):
            raise InputError(
                f"Object {number} cannot be {factor:g} times as far away: give a number from {MIN_FACTOR:g} to {MAX_FACTOR:g}."
            )


@torch.no_grad()
def slice_view(
    gaussians: Gaussians4D,
    camera: Camera,
    t: float,
    next_time: float | None = None,
    distances: Distances | None = None,
    eps2d: float = EPS2D,
) -> Slice:
    """Return the Gaussians that a camera may show, at clip time ``t``: see ``slice_gaussians``.

    Args:
        gaussians: the model.
        camera: in normalized coordinates.
        t: clip time.
        next_time: the other time of a flow pair.
        distances: of objects that are not where they were trained.
        eps2d: px^2 of blur that they will be rendered with.
    """
    seen = gaussians.active(t, camera, eps2d=eps2d)
    viewer = torch.as_tensor(camera.center, dtype=gaussians.params["means"].dtype)
    if distances is None:
        return slice_gaussians(gaussians, seen, viewer, next_time)
    known = gaussians.object_ids.new_tensor(list(distances.factors))
    parts = [slice_gaussians(gaussians, _only(seen, ~torch.isin(gaussians.object_ids, known)), viewer, next_time)]
    everywhere = gaussians.active(t)  # what a camera sees of those that are moved is not told by where they were
    for number, factor in distances.factors.items():
        chosen = _only(everywhere, gaussians.object_ids == number)
        if len(chosen.rows):
            parts.append(_move_slice(gaussians, chosen, viewer, next_time, distances, factor))
    return _join(parts)


def _only(active: Active, wanted: Tensor) -> Active:
    """Select of the active Gaussians those that are wanted ([N] bool); none of them may be padding."""
    keep = wanted[active.rows]
    return Active(active.rows[keep], int(keep[: active.num_static].sum()), active.t)


def _move_slice(
    gaussians: Gaussians4D, active: Active, viewer: Tensor, next_time: float | None, distances: Distances, factor: float
) -> Slice:
    """Return the slice of one object; all of its rows move, for what rests of it goes with the camera."""

    def like(values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=viewer.dtype, device=gaussians.device)

    # Seen from the viewer the moved Gaussian is where its original is for one who stands so much nearer to C(t), or farther.
    here = torch.as_tensor(distances.center(active.t), dtype=viewer.dtype)
    found = slice_gaussians(gaussians, active, here + (viewer - here) / factor, next_time)
    resting = found.velocities.new_zeros(active.num_static, 3)
    center, next_means = like(distances.center(active.t)), None
    if next_time is not None:
        assert found.next_means is not None
        next_center = like(distances.center(next_time))
        next_means = next_center + factor * (found.next_means - next_center)
    return Slice(
        means=center + factor * (found.means - center),
        quats=found.quats,
        scales=None if found.scales is None else factor * found.scales,
        covars=None if found.covars is None else factor**2 * found.covars,
        opacities=found.opacities,
        colors=found.colors,
        velocities=factor * torch.cat([resting, found.velocities]) + (1 - factor) * like(distances.compute_speed(active.t)),
        next_means=next_means,
        next_quats=found.next_quats,
        slopes=found.slopes,
    )


def _join(parts: list[Slice]) -> Slice:
    """Return one slice; of all parts but the first every row moves."""

    def joined(values: list[Tensor | None]) -> Tensor | None:
        known = [value for value in values if value is not None]
        return torch.cat(known) if known else None

    def all_of(name: str) -> Tensor:
        return torch.cat([getattr(part, name) for part in parts])

    return Slice(
        means=all_of("means"),
        quats=joined([part.quats for part in parts]),
        scales=joined([part.scales for part in parts]),
        covars=joined([part.covars for part in parts]),
        opacities=all_of("opacities"),
        colors=all_of("colors"),
        velocities=all_of("velocities"),
        next_means=joined([part.next_means for part in parts]),
        next_quats=joined([part.next_quats for part in parts]),
        slopes=joined([part.slopes for part in parts]),
    )
