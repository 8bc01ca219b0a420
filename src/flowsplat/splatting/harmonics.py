"""Real spherical harmonics as colors, with the constants and the sign convention of 3D Gaussian Splatting."""

from __future__ import annotations

import torch
from torch import Tensor

from flowsplat.splatting.rules import C0, C1, C2, C3, C4

MAX_DEGREE = 4
"""Of those that have a basis here."""


def harmonics_count(degree: int) -> int:
    """Return how many coefficients a degree has."""
    return (degree + 1) ** 2


def harmonics_basis(directions: Tensor, degree: int) -> Tensor:
    """Return [..., 3] unit directions to [..., (degree + 1)^2] basis values; degree 0 to 4."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, C0)]
    if degree > 0:
        basis += [-C1 * y, C1 * z, -C1 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        basis += [C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * zz - xx - yy), C2[3] * x * z, C2[4] * (xx - yy)]
    if degree > 2:
        basis += [
            C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy), C3[4] * x * (4 * zz - xx - yy), C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3 * yy),
        ]  # fmt: skip
    if degree > 3:
        xy, xz, yz = x * y, x * z, y * z
        basis += [
            C4[0] * xy * (xx - yy), C4[1] * yz * (3 * xx - yy), C4[2] * xy * (7 * zz - 1), C4[3] * yz * (7 * zz - 3),
            C4[4] * (zz * (35 * zz - 30) + 3), C4[5] * xz * (7 * zz - 3), C4[6] * (xx - yy) * (7 * zz - 1),
            C4[7] * xz * (xx - 3 * yy), C4[8] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]  # fmt: skip
    return torch.stack(basis, -1)


def colors_from_harmonics(sh: Tensor, directions: Tensor | None, degree: int) -> Tensor:
    """Coefficients [N, K, 3] seen along directions [N, 3] to colors [N, 3] >= 0; only coefficients up to ``degree`` count.

    Directions may have any length; at degree 0 they are not needed.
    """
    if degree == 0 or directions is None:
        return (C0 * sh[:, 0] + 0.5).clamp(min=0)
    if sh.device.type == "cpu" and sh.dtype == directions.dtype == torch.float32:
        from flowsplat.splatting.cpu import harmonics

        return harmonics.colors(sh, directions, degree)
    return colors_in_torch(sh, directions, degree)


def colors_in_torch(sh: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Return the oracle of the kernel behind ``colors_from_harmonics``."""
    basis = harmonics_basis(torch.nn.functional.normalize(directions, dim=-1), degree)
    return ((basis[..., None] * sh[:, : basis.shape[-1]]).sum(1) + 0.5).clamp(min=0)


def harmonics_from_colors(colors: Tensor) -> Tensor:
    """Return the degree-0 coefficient of a color."""
    return (colors - 0.5) / C0
