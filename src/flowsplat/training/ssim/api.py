"""The one place that picks who computes the colour loss."""

from __future__ import annotations

import torch
from torch import Tensor

from flowsplat.training.ssim import reference


def colour_loss(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """(1 - gamma_1) L1 + gamma_1 (1 - SSIM) of two pictures [H, W, 3] in 0..1 (METHOD 5), differentiable in ``image``.

    SSIM has an 11 x 11 Gaussian window of sigma 1.5 and zeros beyond the border, as 3D Gaussian Splatting trains with.
    """
    if image.device.type == "cpu" and image.dtype == torch.float32:
        from flowsplat.training.ssim import cpu

        return cpu.colour_loss(image, target, ssim_weight)
    return reference.colour_loss(image, target, ssim_weight)
