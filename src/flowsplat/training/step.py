"""What a step rendered of one frame: what loss terms, strategies and callbacks see."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from flowsplat.gaussians.gaussians4d import Active
from flowsplat.gaussians.observations import Observations
from flowsplat.gaussians.render import RenderedFrame
from flowsplat.training.history import Figures
from flowsplat.training.photometric_loss import PhotometricTargets

if TYPE_CHECKING:
    from flowsplat.training.config import TrainConfig
    from flowsplat.training.state import TrainState


@dataclass
class StepOutput:
    """One training frame as it was rendered, and what it should have looked like.

    Attributes:
        state: all that is trained.
        config: every setting of training.
        observations: all training frames.
        frame: which of them this is.
        targets: its colors, depth and flow.
        active: which Gaussians were rendered.
        rendered: the differentiable images; once the loss is differentiated ``rendered.projected.means2d.grad`` is there where a
            strategy asked for it.
        step: how many steps were done before.
        count: how many Gaussians there were.
        ends_step: the optimizer's step was taken; False for all but the last frame of a step.
        figures: of the loss, by name; terms may add to them.
    """

    state: TrainState
    config: TrainConfig
    observations: Observations
    frame: int
    targets: PhotometricTargets
    active: Active
    rendered: RenderedFrame
    step: int
    count: int
    ends_step: bool = False
    figures: Figures = field(default_factory=dict)

    @property
    def visible(self) -> Tensor:
        """[A] bool, which of the active Gaussians were drawn."""
        return self.rendered.projected.visible

    @property
    def times(self) -> np.ndarray:
        """[T] clip times of all training frames."""
        return self.observations.times
