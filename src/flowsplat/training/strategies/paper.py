"""The paper's density control, which is that of 3D Gaussian Splatting with times: clone, split, prune, reset
(docs/method/training.md)."""

from __future__ import annotations

import torch

from flowsplat.common.devices import upload
from flowsplat.gaussians.density import DensityStatistics, densify, prune, reset_opacities
from flowsplat.gaussians.observations import Observations
from flowsplat.training.config import TrainConfig
from flowsplat.training.state import TrainState
from flowsplat.training.step import StepOutput
from flowsplat.training.strategies import STRATEGIES


@STRATEGIES.register("paper", "The paper's", "Clone, split, prune and reset as 3D Gaussian Splatting does.", place=20)
class PaperStrategy:
    """Every ``density.every`` steps: what the image pulls at is cloned or split, what nobody sees is removed."""

    def __init__(self, config: TrainConfig, observations: Observations):
        """As ``STRATEGIES`` makes them."""
        self.config, self.observations = config, observations

    def initialize_state(self, state: TrainState) -> None:
        """Begin to count."""
        state.statistics = vars(DensityStatistics.zeros(len(state.gaussians), state.gaussians.device))

    def step_pre_backward(self, state: TrainState, step: StepOutput) -> None:
        """Ask for the gradients of the 2D means."""
        if self.config.density.gradient > 0:
            step.rendered.projected.means2d.retain_grad()

    def step_post_backward(self, state: TrainState, step: StepOutput) -> None:
        """Count, and change Gaussians where a round is due."""
        self.count(DensityStatistics(**state.statistics), step)
        config, done, iterations = self.config.density, state.step, self.config.iterations
        # After the last step nothing would be trained any more: children would stay where chance put them.
        if not step.ends_step or done >= iterations:
            return
        if config.every and config.start <= done <= config.stop * iterations and done % config.every == 0:
            self.control(state, DensityStatistics(**state.statistics))
            self.initialize_state(state)
        if config.reset_every and done % config.reset_every == 0 and not self.config.is_averaged(done):
            reset_opacities(state.gaussians, config.reset_to)
            state.optimizer.restart("logit_opacities")

    def count(self, statistics: DensityStatistics, step: StepOutput) -> None:
        """Add this image's gradients of the 2D means."""
        if self.config.density.gradient > 0:
            add_image_gradients(statistics, step)

    def control(self, state: TrainState, statistics: DensityStatistics) -> None:
        """Add and remove Gaussians."""
        config = self.config.density
        if config.gradient > 0:
            state.adopt(
                densify(state.gaussians, statistics, config.gradient, config.clone_below, config.max_gaussians, state.generator)
            )
        large = config.prune_scale if config.reset_every and state.step > config.reset_every else 0.0
        state.adopt(prune(state.gaussians, self.observations.times, config.prune_opacity, large))


def add_image_gradients(statistics: DensityStatistics, step: StepOutput) -> None:
    """Add to ``gradient`` and ``visits`` what an image says: the 2D means kept their gradients (``retain_grad``)."""
    active, gradient = step.active, step.rendered.projected.means2d.grad
    assert gradient is not None
    rows, (width, height) = active.valid(active.rows), step.observations.size
    scaled = gradient * upload(torch.tensor([width / 2, height / 2], dtype=gradient.dtype), gradient.device)
    statistics.gradient[rows] += active.valid(torch.where(step.visible, scaled.norm(dim=1), 0))
    statistics.visits[rows] += active.valid(step.visible)
