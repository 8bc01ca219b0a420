"""Define what every strategy of density control offers."""

from __future__ import annotations

from typing import Protocol

from flowsplat.training.state import TrainState
from flowsplat.training.step import StepOutput


class Strategy(Protocol):
    """What a strategy offers. It keeps nothing itself that a checkpoint would lack: that goes into ``TrainState.statistics``."""

    def initialize_state(self, state: TrainState) -> None:
        """Fill ``state.statistics`` with what it keeps for every Gaussian, before the first step."""
        ...

    def step_pre_backward(self, state: TrainState, step: StepOutput) -> None:
        """Before the loss of a frame is differentiated. On a GPU the frame may be computed again: change nothing of the state."""
        ...

    def step_post_backward(self, state: TrainState, step: StepOutput) -> None:
        """After the loss of a frame was differentiated: count what was seen of the Gaussians.

        Where ``step.ends_step`` the optimizer has stepped, too, and ``state.step`` is one more: now, and only now, Gaussians may be
        changed, and others be adopted (``state.adopt``).
        """
        ...
