"""The oracle of the photometric loss, in plain torch."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from flowsplat.gaussians.flow import flow_image
from flowsplat.training.photometric_loss.api import ImageFigures, PhotometricTargets, PhotometricWeights, Plane

RADIUS, SIGMA, C1, C2 = 5, 1.5, 0.01**2, 0.03**2
"""Of SSIM: pixels of the window to either side and its standard deviation, and the constants of Wang et al. 2004
(docs/method/evaluation.md)."""
MIN_FLOW_ALPHA = 0.5
"""Alpha from which a pixel's flow counts, if it is compared by alpha (docs/method/flow.md, "Flow splatting")."""
MAX_UNSEEN_SHARE = 0.05
"""Share of alpha that may be held by what the other camera cannot see (docs/method/flow.md, "Flow splatting")."""


def window() -> np.ndarray:
    """Return [11] the one-dimensional Gaussian window, sum 1."""
    taps = np.exp(-((np.arange(2 * RADIUS + 1) - RADIUS) ** 2) / (2 * SIGMA**2))
    return taps / taps.sum()


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Return [3, H, W] from two images [H, W, 3]."""
    taps = torch.as_tensor(window(), dtype=image.dtype, device=image.device)
    kernel = torch.outer(taps, taps)[None, None]

    def blur(planes: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(planes[:, None], kernel, padding=RADIUS)[:, 0]

    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    return ((2 * mx * my + C1) * (2 * cov + C2)) / ((mx * mx + my * my + C1) * (vx + vy + C2))


def color_loss(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """Return (1 - gamma_1) L1 + gamma_1 (1 - SSIM) of two images [H, W, 3] between 0 and 1."""
    l1 = (image - target).abs().mean()
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim_map(image, target).mean())


def flow_loss(flow: Tensor, alpha: Tensor, target: Tensor, valid: Tensor, by_alpha: bool) -> Tensor:
    """L1 in pixels between splatted [H, W, 2] and prior flow, mean over valid pixels [H, W] and both components."""
    if by_alpha:
        target = alpha[..., None] * target
        valid = valid & (alpha >= MIN_FLOW_ALPHA)
    error = (flow - target).abs().sum(-1)
    return (error * valid).sum() / (2 * valid.sum().clamp(min=1))


def depth_loss(depth: Tensor, alpha: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Relative L1 between splatted [H, W] (premultiplied) and prior depth [H, W], mean over all pixels."""
    error = (depth - alpha * target).abs() / target
    return (error * valid).sum() / error.numel()


def photometric_loss(
    image: Tensor, alpha: Tensor, flow_channels: int, targets: PhotometricTargets, weights: PhotometricWeights
) -> tuple[Tensor, ImageFigures]:
    """See ``api.photometric_loss``."""

    def tensor(plane: Plane) -> Tensor:
        value = torch.as_tensor(plane, device=image.device)
        return value if value.dtype == torch.bool else value.to(image.dtype)

    target = tensor(targets.color) / 255
    color, end = image[..., :3], 4 + flow_channels
    parts = {"color": color_loss(color, target, weights.ssim)}
    total = parts["color"]
    if targets.flow is not None and weights.flow > 0:
        assert targets.flow_trusted is not None
        valid = tensor(targets.flow_trusted)
        if image.shape[2] > end:
            valid = valid & (image[..., end] <= MAX_UNSEEN_SHARE * alpha)
        parts["flow"] = flow_loss(flow_image(image[..., 4:end]), alpha, tensor(targets.flow), valid, weights.flow_by_alpha)
        total = total + weights.flow * parts["flow"]
    if targets.depth is not None and weights.depth > 0:
        assert targets.depth_trusted is not None
        parts["depth"] = depth_loss(image[..., 3], alpha, tensor(targets.depth), tensor(targets.depth_trusted))
        total = total + weights.depth * parts["depth"]
    squared = ((color.detach().clamp(0, 1) - target) ** 2).mean()
    figures = {name: float(part.detach()) for name, part in parts.items()}
    return total, ImageFigures(figures["color"], figures.get("flow", 0.0), figures.get("depth", 0.0), float(squared))
