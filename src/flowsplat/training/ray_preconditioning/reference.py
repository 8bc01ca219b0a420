"""The oracle, in plain torch: how fast positions at rest learn along their ray.

A step across the ray shifts a Gaussian in every image, one along it only as far as the camera traveled. Adam takes steps of one
size in all directions, so depth learns slowest of all, in proportion to parallax; along the ray the steps are therefore longer by
that.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from flowsplat.training.adam import RowAdam

HALF_PARALLAX = 4.0
"""Parallax, as a standard deviation over the clip, at which half of that counts: below it the images hardly tell a depth
(docs/method/training.md)."""


@dataclass(frozen=True)
class PathSpread:
    """How far the cameras of a clip traveled, and where.

    Attributes:
        middle: [3] of their centers.
        covariance: [3, 3] of them.
        numbers: [12] both, one after the other, for kernels.
    """

    middle: Tensor
    covariance: Tensor
    numbers: Tensor

    @staticmethod
    def of(centers: Tensor, device: torch.device | str = "cpu") -> PathSpread:
        """Return the spread of centers [F, 3], on a device."""
        middle = centers.mean(0)
        path = centers - middle
        covariance = path.T @ path / len(centers)
        parts = middle, covariance, torch.cat([middle, covariance.reshape(-1)])
        return PathSpread(*(part.to(device) for part in parts))


def ray_axes(positions: Tensor, path: PathSpread, focal: float, most: float) -> tuple[Tensor, Tensor]:
    """Axes to step along, and how many times as long the steps along the last of them are.

    With z the distance from the middle of the camera's path and s the standard deviation of that path across the ray, a step along
    the ray shifts a Gaussian by s / z of what one across it does. Half of what that asks for is given.

    Args:
        positions: [A, 3].
        path: of the cameras.
        focal: pixels.
        most: upper bound of the factor, at least 1.

    Returns:
        [A, 3, 3] orthonormal rows, the last along the ray, and factors [A] from 1 to ``most``.
    """
    spread = path.covariance
    rays = positions - path.middle
    distance = rays.norm(dim=1).clamp_min(1e-9)
    along = rays / distance[:, None]
    across = (spread.trace() - ((along @ spread) * along).sum(1)).clamp_min(0).sqrt()
    seen = (focal * across / distance).square()
    factors = (distance / (2 * across).clamp_min(1e-9)).clamp(1, most)
    factors = 1 + (factors - 1) * seen / (seen + HALF_PARALLAX**2)
    # Any two directions across will do: beginning with the world's axis that is least along the ray.
    least = torch.zeros_like(along).scatter_(1, along.abs().argmin(1, keepdim=True), 1)
    first = torch.nn.functional.normalize(torch.linalg.cross(along, least), dim=1)
    return torch.stack([first, torch.linalg.cross(along, first), along], 1), factors


def step_along_rays(
    adam: RowAdam, name: str, value: Tensor, rows: Tensor, stepped: Tensor, gradient: Tensor, rates: Tensor,
    path: PathSpread, focal: float, most: float,
) -> None:  # fmt: skip
    """See ``api.step_along_rays``."""
    axes, factors = ray_axes(value[rows], path, focal, most)
    moved = torch.zeros_like(value)
    adam.step(name, moved, rows, stepped, (axes @ gradient[:, :, None])[:, :, 0], rates)
    steps = moved[rows]
    steps[:, 2] *= factors
    value[rows] += (steps[:, None] @ axes)[:, 0]
