"""The rigid loss, and the one place that picks who computes it."""

from __future__ import annotations

import torch
from torch import Tensor

from flowsplat.training.rigidity.neighbours import Neighbours


def rigid_loss(velocities: Tensor, rows: Tensor, neighbours: Neighbours, count: int) -> Tensor:
    """L_rigid = 1 / (k count) sum_i sum_j w_ij |v_i - v_j| over the pairs that are both active, the norm safe at 0 (METHOD 5).

    Args:
        velocities: [M, 3] of active Gaussians, per clip length.
        rows: [M] int64, which Gaussians they are.
        neighbours: of all Gaussians.
        count: M for ours; the number of all Gaussians for the paper's.
    """
    from flowsplat.training.rigidity import cpu, reference

    module = cpu if velocities.device.type == "cpu" and velocities.dtype == torch.float32 else reference
    return module.rigid_loss(velocities, rows, neighbours, count)
