"""Move points by a screw motion each, in closed form."""

from __future__ import annotations

import torch
from torch import Tensor

MIN_SQUARED_ANGLE = 1e-8
"""Squared radians below which sines are taken from their series: in float32 they would be 0 / 0."""


def move_by_screws(points: Tensor, screws: Tensor) -> Tensor:
    """Return points moved by exp of a screw axis: a rotation by |r| radians about r, and a translation along with it.

    Lynch and Park 2017 (Modern Robotics), equations 3.51 and 3.88, as Nerfies (https://arxiv.org/abs/2011.12948, section 3.2) and
    HyperNeRF use them.

    Args:
        points: [..., 3].
        screws: [..., 6]: r in radians, and v.

    Returns:
        [..., 3] R p + G v.
    """
    axis, velocity = screws[..., :3], screws[..., 3:]
    squared = (axis * axis).sum(-1, keepdim=True)
    is_small = squared < MIN_SQUARED_ANGLE
    # The branch that is not taken must have a finite gradient, too.
    safe = torch.where(is_small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    sine = torch.where(is_small, 1 - squared / 6, torch.sin(angle) / angle)
    cosine = torch.where(is_small, 0.5 - squared / 24, (1 - torch.cos(angle)) / safe)
    cubic = torch.where(is_small, 1 / 6 - squared / 120, (angle - torch.sin(angle)) / (safe * angle))
    across, along = torch.linalg.cross(axis, points), torch.linalg.cross(axis, velocity)
    rotated = points + sine * across + cosine * torch.linalg.cross(axis, across)
    return rotated + velocity + cosine * along + cubic * torch.linalg.cross(axis, along)
