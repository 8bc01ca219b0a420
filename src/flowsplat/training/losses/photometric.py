"""Color, structure, flow and depth of the image: one fused operation, and so one term (``training.photometric_loss``)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from flowsplat.training.losses import register_loss
from flowsplat.training.photometric_loss import PhotometricWeights, photometric_loss
from flowsplat.training.step import StepOutput


@register_loss("photometric", "Image", "Colors, flow and depth of the image, each with its weight.", has_curve=False, place=0)
def photometric(step: StepOutput) -> Tensor:
    """Return the weighted sum of all parts, and add their figures."""
    loss, rendered = step.config.loss, step.rendered
    weights = PhotometricWeights(loss.ssim, loss.flow, loss.depth, loss.flow_by_alpha)
    total, found = photometric_loss(rendered.image, rendered.alpha, rendered.flow_channels, step.targets, weights)
    step.figures.update(color=found.color, flow=found.flow, depth=found.depth, psnr=_psnr(found.squared_error))
    return total


def _psnr(squared_error: float | Tensor) -> float | Tensor:
    if isinstance(squared_error, Tensor):
        return -10 * torch.log10(squared_error.clamp(min=1e-10))
    return -10 * math.log10(max(squared_error, 1e-10))
