"""Our density control: what turns out to move is told to, what rests comes to rest, and what nobody sees is removed."""

from __future__ import annotations

from flowsplat.common.progress import report
from flowsplat.gaussians.density import DensityStatistics, revise_dynamic
from flowsplat.gaussians.initialize import choose_frames
from flowsplat.training.dynamic_evidence import add_residuals
from flowsplat.training.state import TrainState
from flowsplat.training.step import StepOutput
from flowsplat.training.strategies import STRATEGIES
from flowsplat.training.strategies.paper import PaperStrategy

SAMPLE_EVERY = 4
"""Steps between two of which residuals are counted: that is enough evidence. Chosen by eye."""


@STRATEGIES.register("default", "Ours", "What moves becomes dynamic, what rests background; then as paper.", place=10)
class DefaultStrategy(PaperStrategy):
    """The paper's, and before each round it is decided anew which Gaussians move."""

    @property
    def _revises(self) -> bool:
        return self.config.density.revise and self.config.model.freeze_background

    def count(self, statistics: DensityStatistics, step: StepOutput) -> None:
        """Add this image's gradients and residuals."""
        super().count(statistics, step)
        rendered, targets = step.rendered, step.targets
        sampled = self._revises and step.step % SAMPLE_EVERY == 0
        if sampled and rendered.flow is not None and targets.flow is not None:
            add_residuals(statistics, step.active, step.visible, rendered, targets)

    def control(self, state: TrainState, statistics: DensityStatistics) -> None:
        """Decide who moves, then add and remove."""
        if self._revises:
            config = self.config.density
            _, log_lambda = choose_frames(len(self.observations), self.config.init)
            moved, rested = revise_dynamic(
                state.gaussians, statistics, config.revise_flow, config.revise_color, config.revise_rest, self.observations.focal,
                log_lambda,
            )  # fmt: skip
            if moved or rested:
                state.note_revised_motion()
                report(f"Step {state.step}: {moved:,} background Gaussians turned out to move, {rested:,} moving ones rest.")
        super().control(state, statistics)
