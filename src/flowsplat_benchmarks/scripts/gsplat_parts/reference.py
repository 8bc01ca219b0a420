"""What gsplat's ``rasterization`` is documented to return, on the CPU and in any float type.

What belongs to Gaussians (projection, harmonics) is computed by gsplat's own torch functions. Its blending in torch needs nerfacc,
so it is written here, from the equations of 3D Gaussian Splatting: sums over all Gaussians that reach a tile, at all its pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from flowsplat.geometry.rotations import covariances
from flowsplat.splatting.rules import ALPHA_MAX, ALPHA_MIN, EPS2D, FAR_PLANE, NEAR_PLANE, TRANSMITTANCE_MIN

TILE = 16
"""Pixels, of what is blended at once. Which Gaussians are left out follows from their alpha, so nothing else depends on it."""
Rasterize = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]


def rasterize_as_gsplat(
    means: Tensor, quats: Tensor | None, scales: Tensor | None, opacities: Tensor, colors: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, *, near_plane: float = NEAR_PLANE, far_plane: float = FAR_PLANE, eps2d: float = EPS2D,
    sh_degree: int | None = None, backgrounds: Tensor | None = None, render_mode: str = "RGB", absgrad: bool = False,
    rasterize_mode: str = "classic", camera_model: str = "pinhole", covars: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:  # fmt: skip
    """As gsplat's ``rasterization`` of one batch, unpacked, with gradients by autograd; arguments as there."""
    from gsplat.cuda import _torch_impl

    if covars is None:
        assert quats is not None
        assert scales is not None
        covars = covariances(quats, scales)
    radii, means2d, depths, conics, ratios = _torch_impl._fully_fused_projection(
        means, covars, viewmats, Ks, width, height, eps2d, near_plane, far_plane, rasterize_mode == "antialiased", camera_model
    )
    info = {"means2d": means2d, "radii": radii, "width": width, "height": height, "n_cameras": len(viewmats), "gaussian_ids": None}
    if absgrad:
        means2d.absgrad = torch.zeros_like(means2d)
    images, alphas = [], []
    for c, viewmat in enumerate(viewmats):
        color = colors if sh_degree is not None or colors.ndim == 2 else colors[c]
        if sh_degree is not None:
            directions = means - torch.linalg.inv(viewmat)[:3, 3]
            color = (_torch_impl._spherical_harmonics(sh_degree, directions, colors) + 0.5).clamp(min=0)
        features = {"RGB": [color], "D": [], "ED": []}.get(render_mode, [color])
        if "D" in render_mode:
            features.append(depths[c][:, None])
        image, alpha = blend(
            means2d[c], conics[c], depths[c], radii[c], opacities if ratios is None else opacities * ratios[c],
            torch.cat(features, 1), width, height, means2d.absgrad[c] if absgrad else None,
        )  # fmt: skip
        if backgrounds is not None:
            behind = torch.cat([backgrounds[c], backgrounds.new_zeros(image.shape[-1] - backgrounds.shape[-1])])
            image = image + (1 - alpha) * behind
        if "ED" in render_mode:
            image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp(min=1e-10)], -1)
        images.append(image)
        alphas.append(alpha)
    return torch.stack(images), torch.stack(alphas), info


def blend(
    means2d: Tensor, conics: Tensor, depths: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, width: int, height: int,
    absolute: Tensor | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Alpha compositing of one camera's Gaussians (arguments as in its meta): [H, W, D] and [H, W, 1].

    ``absolute`` [N, 2] gets, in backward, the sum over pixels of the absolute gradients of ``means2d``.
    """
    order = torch.nonzero((radii > 0).all(-1)).squeeze(1)
    order = order[depths[order].argsort(stable=True)]
    reach = _reach(conics.detach()[order], opacities.detach()[order])
    centers = means2d.detach()[order]
    rows = []
    for top in range(0, height, TILE):
        row = []
        for left in range(0, width, TILE):
            first = torch.tensor([left, top])
            last = torch.tensor([min(left + TILE, width), min(top + TILE, height)])
            near = order[((centers + reach > first) & (centers - reach < last)).all(-1)]
            row.append(_blend_tile(near, means2d, conics, opacities, features, first.tolist(), last.tolist(), absolute))
        rows.append(torch.cat(row, 1))
    image = torch.cat(rows)
    return image[..., :-1], image[..., -1:]


def _reach(conics: Tensor, opacities: Tensor) -> Tensor:
    """[N, 2] pixels from the center beyond which alpha is below ``ALPHA_MIN``, and one more."""
    a, b, c = conics.unbind(-1)
    variances = torch.stack([c, a], -1) / (a * c - b * b)[:, None]
    return (2 * torch.log((opacities / ALPHA_MIN).clamp(min=1))[:, None] * variances).sqrt() + 1


def _blend_tile(
    near: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor, first: list[int], last: list[int],
    absolute: Tensor | None,
) -> Tensor:  # fmt: skip
    """[h, w, D + 1] of one tile: what the Gaussians ``near``, front to back, look like, and their alpha."""
    y, x = torch.meshgrid(*(torch.arange(first[i], last[i]) + 0.5 for i in (1, 0)), indexing="ij")
    pixels = torch.stack([x, y], -1).reshape(-1, 1, 2).to(means2d)
    centers = means2d[near].expand(len(pixels), -1, -1)
    if absolute is not None and centers.requires_grad:

        def add_absolute(gradient: Tensor) -> None:
            absolute.index_add_(0, near, gradient.abs().sum(0))

        centers.register_hook(add_absolute)
    dx, dy = (pixels - centers).unbind(-1)
    a, b, c = conics[near].unbind(-1)
    alpha = (opacities[near] * torch.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    alpha = torch.where((1 - alpha).cumprod(1) > TRANSMITTANCE_MIN, alpha, torch.zeros_like(alpha))
    after = torch.cat([torch.ones_like(alpha[:, :1]), (1 - alpha).cumprod(1)], 1) if len(near) else alpha.new_ones(len(pixels), 1)
    image = (alpha * after[:, :-1]) @ features[near]
    return torch.cat([image, 1 - after[:, -1:]], 1).reshape(*x.shape, -1)
