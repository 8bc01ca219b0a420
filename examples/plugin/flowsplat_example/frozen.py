"""A strategy of density control: there is none, and every Gaussian stays. ``--train.strategy frozen`` takes it."""

from __future__ import annotations

from flowsplat.gaussians.observations import Observations
from flowsplat.training.config import TrainConfig
from flowsplat.training.state import TrainState
from flowsplat.training.step import StepOutput
from flowsplat.training.strategies import STRATEGIES


@STRATEGIES.register("frozen", "Frozen", "Every Gaussian stays as it came.")
class Frozen:
    """Adds and removes nothing."""

    def __init__(self, config: TrainConfig, observations: Observations):
        """It needs nothing of them."""

    def initialize_state(self, state: TrainState) -> None:
        """Keep nothing of the Gaussians."""

    def step_pre_backward(self, state: TrainState, step: StepOutput) -> None:
        """Ask for nothing."""

    def step_post_backward(self, state: TrainState, step: StepOutput) -> None:
        """Change nothing."""
