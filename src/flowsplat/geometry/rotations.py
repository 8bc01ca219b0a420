"""Quaternions (wxyz) in torch."""

from __future__ import annotations

import torch
from torch import Tensor


def normalize_quats(quats: Tensor, eps: float = 1e-12) -> Tensor:
    """Return unit quaternions [..., 4]; a zero quaternion stays zero instead of becoming NaN, and so does its gradient."""
    squared = (quats * quats).sum(-1, keepdim=True)
    return quats * torch.rsqrt(torch.clamp(squared, min=eps * eps))


def multiply_quats(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product [..., 4]."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def quats_to_rotations(quats: Tensor) -> Tensor:
    """Quaternions [..., 4] of any length to rotation matrices [..., 3, 3]."""
    w, x, y, z = normalize_quats(quats).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def rotations_to_quats(rotations: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] to unit quaternions [..., 4] with w >= 0.

    The four candidates (largest of w, x, y, z first) are computed for all and the best conditioned one is taken.
    """
    m = rotations
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = torch.stack([1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], -1)
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    candidates = torch.stack(
        [
            torch.stack([squares[..., 0], wx, wy, wz], -1),
            torch.stack([wx, squares[..., 1], xy, xz], -1),
            torch.stack([wy, xy, squares[..., 2], yz], -1),
            torch.stack([wz, xz, yz, squares[..., 3]], -1),
        ],
        -2,
    )
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quats = torch.gather(candidates, -2, best).squeeze(-2)
    quats = quats / quats.norm(dim=-1, keepdim=True)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Sigma = R S S^T R^T [..., 3, 3] from quaternions [..., 4] and scales [..., 3]."""
    M = quats_to_rotations(quats) * scales[..., None, :]
    return M @ M.transpose(-1, -2)


def principal_axes(covars: Tensor) -> tuple[Tensor, Tensor]:
    """Covariances [N, 3, 3] to unit quaternions [N, 4] and log scales [N, 3]. Not for gradients: NaN at equal scales."""
    values, axes = torch.linalg.eigh(covars.double())
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    return rotations_to_quats(axes).to(covars), (0.5 * torch.log(values.clamp(min=1e-16))).to(covars)
