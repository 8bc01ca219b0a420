"""A loss term: pixels are either covered or not, nothing in between. ``--train.loss.opaque 0.1`` switches it on."""

from __future__ import annotations

from torch import Tensor

from flowsplat.training.losses import register_loss
from flowsplat.training.step import StepOutput


@register_loss("opaque", "Opaque", "Pixels are covered or not, nothing in between.", weight=0.0)
def opaque(step: StepOutput) -> Tensor:
    """Return the mean of 4 alpha (1 - alpha) of the image, 0 to 1."""
    alpha = step.rendered.alpha
    return 4 * (alpha * (1 - alpha)).mean()
