"""psi and its Jacobian in torch, differentiable (docs/method/index.md)."""

from __future__ import annotations

import torch
from torch import Tensor

TANGENT_MARGIN = 0.15
"""Image sizes beyond the border at which the tangents of a Jacobian are clamped, as in gsplat."""


def to_camera(points: Tensor, viewmat: Tensor) -> Tensor:
    """Convert world points [..., 3] to camera axes [..., 3]."""
    return points @ viewmat[:3, :3].T + viewmat[:3, 3]


def project_points(points: Tensor, viewmat: Tensor, K: Tensor, near: float = 1e-6) -> tuple[Tensor, Tensor]:
    """psi(x, k): world points [..., 3] to pixels [..., 2], with their planar depths [...].

    Depths below ``near`` are replaced by ``near`` in the division, so that nothing explodes; the caller masks them.
    """
    p = to_camera(points, viewmat)
    z = p[..., 2]
    inverse = 1.0 / torch.where(z > near, z, torch.full_like(z, near))
    u = K[0, 0] * p[..., 0] * inverse + K[0, 2]
    v = K[1, 1] * p[..., 1] * inverse + K[1, 2]
    return torch.stack([u, v], -1), z


def camera_jacobian(camera_points: Tensor, K: Tensor, width: int, height: int, near: float = 1e-6) -> Tensor:
    """Return [..., 2, 3] derivative of the pixel with respect to the point in camera axes.

    Like gsplat, x / z and y / z are clamped to ``TANGENT_MARGIN`` image sizes beyond the border, so that a Gaussian far outside the
    image does not get a needle-shaped footprint that reaches into it.
    """
    x, y, z = camera_points.unbind(-1)
    inverse = 1.0 / torch.where(z > near, z, torch.full_like(z, near))
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = TANGENT_MARGIN * width, TANGENT_MARGIN * height
    tx = torch.maximum(torch.minimum(x * inverse, (width + margin_x - cx) / fx), (-margin_x - cx) / fx)
    ty = torch.maximum(torch.minimum(y * inverse, (height + margin_y - cy) / fy), (-margin_y - cy) / fy)
    zero = torch.zeros_like(inverse)
    row_u = torch.stack([fx * inverse, zero, -fx * tx * inverse], -1)
    row_v = torch.stack([zero, fy * inverse, -fy * ty * inverse], -1)
    return torch.stack([row_u, row_v], -2)


def world_jacobian(points: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int, near: float = 1e-6) -> Tensor:
    """J_k(x) [..., 2, 3]: derivative of psi with respect to the world point, clamped as in ``camera_jacobian``."""
    return camera_jacobian(to_camera(points, viewmat), K, width, height, near) @ viewmat[:3, :3]
