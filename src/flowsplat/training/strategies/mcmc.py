"""Density control as gsplat's ``MCMCStrategy`` has it: 3D Gaussian Splatting as Markov Chain Monte Carlo
(https://arxiv.org/abs/2404.09591).

The transparent are moved to where the opaque are, new ones come there, too, and positions get noise. Its settings are ours of
another name: ``cap_max`` is ``density.max_gaussians``, ``min_opacity`` is ``density.prune_opacity``, ``refine_*`` are
``density.start``, ``.stop`` and ``.every``. Its two regularizers are the loss terms ``opacity`` and ``scale``; gsplat gives them a
weight of 0.01.
"""

from __future__ import annotations

import torch
from torch import Tensor

from flowsplat.gaussians.density import DensityResult
from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.observations import Observations
from flowsplat.geometry.rotations import covariances
from flowsplat.splatting.relocation import share_place
from flowsplat.training.config import TrainConfig
from flowsplat.training.schedule import LearningRates
from flowsplat.training.state import TrainState
from flowsplat.training.step import StepOutput
from flowsplat.training.strategies import STRATEGIES

NOISE_RATE = 5e5
"""Times the learning rate of positions: how far noise moves them (gsplat 1.5, ``noise_lr``)."""
GROWTH = 0.05
"""Share of new Gaussians in a round (gsplat 1.5)."""


@STRATEGIES.register("mcmc", "gsplat's MCMC", "Move the transparent to the opaque, as gsplat's MCMCStrategy.", place=40)
class MCMCStrategy:
    """A fixed budget of Gaussians that go where they are needed."""

    def __init__(self, config: TrainConfig, observations: Observations):
        """As ``STRATEGIES`` makes them."""
        self.config, self._focal = config, observations.focal

    def initialize_state(self, state: TrainState) -> None:
        """Keep nothing of the Gaussians."""

    def step_pre_backward(self, state: TrainState, step: StepOutput) -> None:
        """Ask for nothing."""

    @torch.no_grad()
    def step_post_backward(self, state: TrainState, step: StepOutput) -> None:
        """Move the dead, add new ones where that is due, and add noise."""
        if not step.ends_step or state.step >= self.config.iterations:
            return
        config = self.config.density
        if config.every and config.start < step.step < config.stop * self.config.iterations and step.step % config.every == 0:
            opacities = torch.sigmoid(state.gaussians.params["logit_opacities"])
            dead = torch.nonzero(opacities <= config.prune_opacity).squeeze(1)
            if 0 < len(dead) < len(opacities):
                self._share(state, dead, torch.where(opacities > config.prune_opacity, opacities, 0))
            count = len(state.gaussians)
            target = min(config.max_gaussians, int((1 + GROWTH) * count))
            if target > count:
                self._share(
                    state, torch.arange(count, target, device=dead.device), torch.sigmoid(state.gaussians.params["logit_opacities"])
                )
        self._add_noise(state)

    def _share(self, state: TrainState, rows: Tensor, weights: Tensor) -> None:
        """Put Gaussians into ``rows``, which may lie behind the last one, as copies of some that are drawn by ``weights`` [N]; all
        that share a place become as opaque and as large as to look together as the one did."""
        gaussians, floor = state.gaussians, self.config.density.prune_opacity
        sources = torch.multinomial(weights.cpu(), len(rows), True, generator=state.generator).to(rows.device)
        sharers = torch.bincount(sources, minlength=len(gaussians))[sources] + 1
        opacities, factors = share_place(torch.sigmoid(gaussians.params["logit_opacities"][sources]), sharers)
        gaussians.params["logit_opacities"][sources] = torch.logit(opacities.clamp(floor, 1 - 1e-7))
        for name, parameter in gaussians.motion.parameters.items():
            if parameter.rate == "scale":
                values = gaussians.params[name]
                values[sources] = values[sources] + factors.log().view(-1, *(1,) * (values.ndim - 1))
        index = torch.arange(max(len(gaussians), int(rows.max()) + 1), device=rows.device)
        index[rows] = sources
        is_new = torch.zeros(len(index), dtype=torch.bool, device=rows.device)
        is_new[sources] = is_new[rows] = True  # their moments were those of another place or size
        state.adopt(DensityResult(gaussians.select(index), index, is_new))

    def _add_noise(self, state: TrainState) -> None:
        """Move the transparent about, within their own shape."""
        gaussians = state.gaussians
        rates = LearningRates(self.config.rates, self.config.iterations, self._focal, gaussians.device)
        scale = NOISE_RATE * float(rates.at(state.step, gaussians)["means"][0])
        transparent = torch.sigmoid(100 * (1 - torch.sigmoid(gaussians.params["logit_opacities"]) - 0.995))
        noise = torch.randn(len(gaussians), 3, generator=state.generator).to(gaussians.device)
        covars = _covariances(gaussians)
        gaussians.params["means"] += (covars @ (scale * transparent[:, None] * noise)[..., None])[..., 0]


def _covariances(gaussians: Gaussians4D) -> Tensor:
    """Return [N, 3, 3] at the center times."""
    shape = gaussians.motion.at_rest(gaussians.params)
    if shape.covars is not None:
        return shape.covars
    assert shape.quats is not None
    assert shape.scales is not None
    return covariances(shape.quats, shape.scales)
