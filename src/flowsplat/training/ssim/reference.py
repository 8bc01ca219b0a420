"""The oracle of the colour loss."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

RADIUS, SIGMA, C1, C2 = 5, 1.5, 0.01**2, 0.03**2


def window() -> np.ndarray:
    """[11] the one-dimensional Gaussian window, sum 1."""
    taps = np.exp(-((np.arange(2 * RADIUS + 1) - RADIUS) ** 2) / (2 * SIGMA**2))
    return taps / taps.sum()


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """[3, H, W] from two pictures [H, W, 3]."""
    taps = torch.as_tensor(window(), dtype=image.dtype, device=image.device)
    kernel = torch.outer(taps, taps)[None, None]

    def blur(planes: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(planes[:, None], kernel, padding=RADIUS)[:, 0]

    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    return ((2 * mx * my + C1) * (2 * cov + C2)) / ((mx * mx + my * my + C1) * (vx + vy + C2))


def colour_loss(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """See ``api.colour_loss``."""
    l1 = (image - target).abs().mean()
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim_map(image, target).mean())
