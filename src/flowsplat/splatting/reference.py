"""The oracle: what every backend must compute, in plain torch, short enough to check by eye.

Works in any float type, differentiates by autograd, and is slow: blending holds [pixels, Gaussians] matrices of a
few rows of the image at a time.
"""

from __future__ import annotations

import torch
from torch import Tensor

from flowsplat.geometry.projection import to_camera
from flowsplat.geometry.rotations import covariances
from flowsplat.splatting.camera_models import CameraModel, project_in_camera
from flowsplat.splatting.rules import (
    ALPHA_MAX,
    ALPHA_MIN,
    DETERMINANT_MAX,
    OPACITY_FLOOR,
    RADIUS_MAX,
    SLOPED_FEATURES,
    TRANSMITTANCE_MIN,
)

STRIP_ROWS = 8
"""Rows blended at a time, so that the matrices fit a cache."""


def project(
    means: Tensor,  # [N, 3]
    quats: Tensor | None,  # [N, 4]
    scales: Tensor | None,  # [N, 3]
    covars: Tensor | None,  # [N, 3, 3]
    opacities: Tensor,  # [N]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    eps2d: float,
    camera_model: CameraModel = "pinhole",
    radial_coeffs: Tensor | None = None,  # [4]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """EWA projection: means2d [N, 2], conics [N, 3], depths [N], radii [N, 2] int32 (0 where culled).

    Radii are rounded up to whole pixels, and a Gaussian is culled where not even these reach the image: gsplat's rule.
    """
    if covars is None:
        assert quats is not None
        assert scales is not None
        covars = covariances(quats, scales)
    camera_means = to_camera(means, viewmat)
    depths = camera_means[:, 2]
    inside = (depths > near_plane) & (depths < far_plane)
    safe = torch.where(inside, depths, torch.ones_like(depths))
    camera_means = torch.cat([camera_means[:, :2], safe[:, None]], 1)
    means2d, J, shows = project_in_camera(camera_means, K, width, height, camera_model, radial_coeffs)
    J = J @ viewmat[:3, :3]
    blurred = J @ covars @ J.transpose(1, 2) + eps2d * torch.eye(2, dtype=means.dtype, device=means.device)
    a, b, c = blurred[:, 0, 0], 0.5 * (blurred[:, 0, 1] + blurred[:, 1, 0]), blurred[:, 1, 1]
    determinant = a * c - b * b
    inside = inside & shows & (determinant > 0) & (determinant < DETERMINANT_MAX)
    safe_determinant = torch.where(inside, determinant, torch.ones_like(determinant))
    conics = torch.stack([c, -b, a], 1) / safe_determinant[:, None]
    with torch.no_grad():
        extent = 2 * torch.log(opacities.clamp(min=OPACITY_FLOOR) / ALPHA_MIN)
        half = torch.ceil(torch.sqrt(extent.clamp(min=0)[:, None] * torch.stack([a, c], 1).clamp(min=0))).clamp(min=1)
        size = torch.tensor([width, height], dtype=means.dtype, device=means.device)
        touches = ((means2d + half > 0) & (means2d - half < size)).all(1)
        visible = inside & touches & (extent > 0)
        radii = torch.where(visible[:, None], half.clamp(max=RADIUS_MAX), torch.zeros_like(half)).to(torch.int32)
    return means2d, conics, depths, radii


def blend(
    means2d: Tensor,  # [N, 2]
    conics: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    features: Tensor,  # [N, C]
    depths: Tensor,  # [N]
    radii: Tensor,  # [N, 2]
    width: int,
    height: int,
    absolute: Tensor | None = None,  # [N, 2]
    slopes: Tensor | None = None,  # [N, 2]
) -> tuple[Tensor, Tensor]:
    """Alpha compositing front to back: features [H, W, C] and alphas [H, W] (docs/method/flow.md, "Compositing").

    ``slopes``: as in ``api.blend``. Backward adds to ``absolute`` the sum over pixels of the absolute gradient of means2d.
    """
    visible = torch.nonzero((radii > 0).all(1)).squeeze(1)
    order = visible[torch.sort(depths[visible], stable=True).indices]
    top, bottom = ((means2d[order, 1].detach() + sign * radii[order, 1]) for sign in (-1, 1))
    strips = [
        _blend_rows(
            means2d, conics, opacities, features, order[(bottom > row) & (top < row + STRIP_ROWS)], width,
            torch.arange(row, min(row + STRIP_ROWS, height)), absolute, slopes,
        )
        for row in range(0, height, STRIP_ROWS)
    ]  # fmt: skip
    images, alphas = zip(*strips, strict=True)
    return torch.cat(images), torch.cat(alphas)


def _blend_rows(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    features: Tensor,
    order: Tensor,
    width: int,
    rows: Tensor,
    absolute: Tensor | None,
    slopes: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Return the given rows of the image, from the Gaussians in ``order``."""
    x = torch.arange(width, dtype=means2d.dtype, device=means2d.device) + 0.5
    y = rows.to(means2d) + 0.5
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 1, 2)
    centers = means2d[order].expand(len(pixels), -1, -1)  # one copy a pixel, so that each pixel's gradient can be seen
    if absolute is not None and centers.requires_grad:

        def add_absolute(gradient: Tensor) -> None:
            absolute.index_add_(0, order, gradient.abs().sum(0))

        centers.register_hook(add_absolute)
    dx, dy = (pixels - centers).unbind(-1)
    a, b, c = conics[order].unbind(-1)
    raw = opacities[order] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = torch.where(raw >= ALPHA_MIN, raw.clamp(max=ALPHA_MAX), torch.zeros_like(raw))
    after = torch.cumprod(1 - alpha, 1)
    drawn = after > TRANSMITTANCE_MIN
    alpha = torch.where(drawn, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    image = (alpha * before) @ features[order]
    if slopes is not None:
        sx, sy = slopes[order].unbind(-1)
        shade = (alpha * before * (sx * dx + sy * dy)).sum(1, keepdim=True)
        image = torch.cat([image[:, :SLOPED_FEATURES] + shade, image[:, SLOPED_FEATURES:]], 1)
    remaining = after[:, -1] if len(order) else torch.ones_like(pixels[:, 0, 0])
    return image.reshape(len(rows), width, -1), (1 - remaining).reshape(len(rows), width)
