"""Opacities are small: what no image needs fades away (3D Gaussian Splatting as Markov Chain Monte Carlo, eq. 10,
https://arxiv.org/abs/2404.09591)."""

from __future__ import annotations

from torch import Tensor

from flowsplat.training.losses import register_loss
from flowsplat.training.step import StepOutput


@register_loss("opacity", "Small opacities", "Mean opacity of the Gaussians at the time (0.01 with strategy mcmc).", weight=0.0)
def opacity(step: StepOutput) -> Tensor | None:
    """Return the mean opacity of the active Gaussians."""
    opacities = step.active.valid(step.rendered.sliced.opacities)
    return opacities.mean() if len(opacities) else None
