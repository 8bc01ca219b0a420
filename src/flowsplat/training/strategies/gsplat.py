"""Density control as gsplat's ``DefaultStrategy`` has it (https://docs.gsplat.studio/main/apis/strategy.html), to compare with.

Its settings are ours of another name: ``refine_start_iter`` is ``density.start``, ``refine_stop_iter`` is ``density.stop`` (a share
of the iterations), ``refine_every`` is ``density.every``, ``grow_grad2d`` is ``density.gradient``, ``grow_scale3d`` is
``density.clone_below``, ``prune_opa`` is ``density.prune_opacity``, ``prune_scale3d`` is ``density.prune_scale``, ``reset_every``
is ``density.reset_every``. Growing by the size in the image, which gsplat has switched off, is not here.
"""

from __future__ import annotations

import torch

from flowsplat.gaussians.density import DensityResult, DensityStatistics, densify, largest_scale, reset_opacities
from flowsplat.gaussians.observations import Observations
from flowsplat.training.config import TrainConfig
from flowsplat.training.state import TrainState
from flowsplat.training.step import StepOutput
from flowsplat.training.strategies import STRATEGIES
from flowsplat.training.strategies.paper import add_image_gradients

RESET_FACTOR = 2.0
"""Opacities are reset to so many times the one below which Gaussians are removed (gsplat 1.5, ``DefaultStrategy``)."""


@STRATEGIES.register("gsplat", "gsplat's default", "Clone, split, prune and reset as gsplat's DefaultStrategy does.", place=30)
class GsplatStrategy:
    """Grow where the gradient in the image is large, prune what is transparent or huge, reset opacities."""

    def __init__(self, config: TrainConfig, observations: Observations):
        """As ``STRATEGIES`` makes them."""
        self.config = config

    def initialize_state(self, state: TrainState) -> None:
        """Begin to count."""
        state.statistics = vars(DensityStatistics.zeros(len(state.gaussians), state.gaussians.device))

    def step_pre_backward(self, state: TrainState, step: StepOutput) -> None:
        """Ask for the gradients of the 2D means."""
        step.rendered.projected.means2d.retain_grad()

    def step_post_backward(self, state: TrainState, step: StepOutput) -> None:
        """Count, and grow, prune or reset where that is due."""
        config, iterations = self.config.density, self.config.iterations
        if step.step >= config.stop * iterations:
            return
        add_image_gradients(DensityStatistics(**state.statistics), step)
        if not step.ends_step or state.step >= iterations:
            return
        if config.every and step.step > config.start and step.step % config.every == 0:
            self._grow(state)
            self._prune(state)
            self.initialize_state(state)
        if config.reset_every and step.step > 0 and step.step % config.reset_every == 0:
            reset_opacities(state.gaussians, RESET_FACTOR * config.prune_opacity)
            state.optimizer.restart("logit_opacities")

    def _grow(self, state: TrainState) -> None:
        """Duplicate small Gaussians and split large ones."""
        config, found = self.config.density, DensityStatistics(**state.statistics)
        state.adopt(densify(state.gaussians, found, config.gradient, config.clone_below, config.max_gaussians, state.generator))

    def _prune(self, state: TrainState) -> None:
        """Remove the transparent and, once opacities were reset, the huge."""
        gaussians, config = state.gaussians, self.config.density
        keep = torch.sigmoid(gaussians.params["logit_opacities"]) >= config.prune_opacity
        if config.prune_scale and config.reset_every and state.step > config.reset_every:
            keep &= largest_scale(gaussians) <= config.prune_scale
        index = torch.nonzero(keep).squeeze(1)
        if 0 < len(index) < len(gaussians):
            state.adopt(DensityResult(gaussians.select(index), index, torch.zeros_like(index, dtype=torch.bool)))
