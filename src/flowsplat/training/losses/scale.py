"""Scales are small: what no image needs shrinks (3D Gaussian Splatting as Markov Chain Monte Carlo, eq. 10,
https://arxiv.org/abs/2404.09591)."""

from __future__ import annotations

from torch import Tensor

from flowsplat.training.losses import register_loss
from flowsplat.training.step import StepOutput


@register_loss("scale", "Small scales", "Mean scale of the Gaussians at the time (0.01 with strategy mcmc).", weight=0.0)
def scale(step: StepOutput) -> Tensor | None:
    """Return the mean scale of the active Gaussians; of a motion model without scales there is none."""
    scales = step.rendered.sliced.scales
    if scales is None or not len(scales):
        return None
    return step.active.valid(scales).mean()
