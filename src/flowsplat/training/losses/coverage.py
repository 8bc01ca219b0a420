"""The coverage loss: how far training pixels are from being covered, which long training would let happen. Ours
(docs/method/training.md)."""

from __future__ import annotations

from torch import Tensor

from flowsplat.training.losses import register_loss
from flowsplat.training.step import StepOutput

UNCOVERED_FROM = 0.3
"""Transmittance that costs nothing. Less than ``render.FILLED_FROM``, from which on rendering fills (docs/method/training.md)."""


def coverage_loss(alpha: Tensor) -> Tensor:
    """Return the mean transmittance above ``UNCOVERED_FROM``, a scalar, differentiable in alpha [H, W].

    Black shows through a pixel that is not covered, so a dark surface need not cover it and, in some thousand steps, comes not to.
    Rendering would take it for a pixel that nothing covers and fill it from its neighbors.
    """
    return (1 - UNCOVERED_FROM - alpha).clamp(min=0).mean()


@register_loss("coverage", "Coverage", "Training pixels are covered.", place=20)
def coverage(step: StepOutput) -> Tensor:
    """Return it for the image of a step."""
    return coverage_loss(step.rendered.alpha)
