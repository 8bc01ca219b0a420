"""Our density control: what turns out to move is told to, what rests comes to rest, and what nobody sees, or would miss, is
removed."""

from __future__ import annotations

import torch

from flowsplat.common.progress import report
from flowsplat.gaussians.density import DensityResult, DensityStatistics, revise_dynamic
from flowsplat.gaussians.initialize import choose_frames
from flowsplat.training.dynamic_evidence import add_residuals
from flowsplat.training.pruning import choose_needed, rank_by_need
from flowsplat.training.state import TrainState
from flowsplat.training.step import StepOutput
from flowsplat.training.strategies import STRATEGIES
from flowsplat.training.strategies.paper import PaperStrategy

SAMPLE_EVERY = 4
"""Steps between two of which residuals are counted: that is enough evidence. Chosen by eye."""
BUDGET_EVERY = 50
"""Steps between two rounds in which Gaussians go that a budget has no room for. Chosen by eye."""
KEPT_IN_A_ROUND = 0.8
"""Share of the Gaussians that have room in such a round, but for the last one before training ends: who is missed is known for a
few of them at a time. Chosen by eye."""


@STRATEGIES.register(
    "default", "Ours", "What moves becomes dynamic, what rests background, what changes nothing goes; then as paper.", place=10
)
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

    def step_post_backward(self, state: TrainState, step: StepOutput) -> None:
        """As the paper's; and once what is not needed is removed."""
        super().step_post_backward(state, step)
        config, late = self.config, state.step - self.config.density.prune_after
        if not step.ends_step or late < 0 or late % BUDGET_EVERY or state.step >= config.iterations:
            return
        if (late == 0 and config.density.prune_change) or 0 < config.gaussians < len(state.gaussians):
            self._remove_unneeded(state)

    def _remove_unneeded(self, state: TrainState) -> None:
        gaussians, config = state.gaussians, self.config
        with torch.enable_grad():
            lost = rank_by_need(gaussians, self.observations, config.seed)
        share = config.density.prune_change if state.step == config.density.prune_after else 0.0
        most = len(gaussians)
        if config.gaussians:
            is_last = state.step + BUDGET_EVERY >= config.iterations
            most = config.gaussians if is_last else max(config.gaussians, int(KEPT_IN_A_ROUND * most))
        rows = choose_needed(lost, share, most)
        if len(rows) < len(gaussians):
            state.adopt(DensityResult(gaussians.select(rows), rows, torch.zeros_like(rows, dtype=torch.bool)))
            report(f"Step {state.step}: {len(gaussians) - len(rows):,} Gaussians that hardly change an image are removed.")

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
