"""The rigid loss: neighbors move alike (``training.rigidity``)."""

from __future__ import annotations

from torch import Tensor

from flowsplat.training.losses import register_loss
from flowsplat.training.rigidity import Neighbors, find_neighbors, rigid_loss
from flowsplat.training.step import StepOutput


@register_loss("rigid", "Rigid motion", "Neighbors move alike.", place=10)
def rigid(step: StepOutput) -> Tensor | None:
    """Return the rigid loss among dynamic Gaussians; with ``rigid_over_all`` among all that may move."""
    config, active, gaussians = step.config.loss, step.active, step.state.gaussians
    moving, velocities = active.rows[active.num_static :], step.rendered.sliced.velocities
    if min(len(moving), len(gaussians)) < 2:
        return None
    count: int | Tensor = len(gaussians)
    if not config.rigid_over_all:
        dynamic = (gaussians.dynamic[moving] & (moving >= 0)).sum().clamp(min=1)
        count = dynamic if dynamic.is_cuda else int(dynamic)
    return rigid_loss(velocities, moving, _neighbors(step), count)


def _neighbors(step: StepOutput) -> Neighbors:
    """Return those of the state, found anew where there are none or they are too old."""
    state, config = step.state, step.config.loss
    if state.neighbors is None or state.step >= state.neighbors_found + config.rigid_refresh:
        state.neighbors = find_neighbors(
            state.gaussians, step.times.tolist(), config.rigid_neighbors, config.rigid_beta, not config.rigid_over_all
        )
        state.neighbors_found = state.step
    return state.neighbors
