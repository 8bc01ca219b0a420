"""The rigid loss, and the one place that picks who computes it."""

from __future__ import annotations

from importlib import import_module

from torch import Tensor

from flowsplat.common import devices
from flowsplat.training.rigidity.neighbours import Neighbours


def rigid_loss(velocities: Tensor, rows: Tensor, neighbours: Neighbours, count: int | Tensor) -> Tensor:
    """L_rigid = 1 / (k count) sum_i sum_j w_ij |v_i - v_j| over the pairs that are both active, the norm safe at 0 (METHOD 5).

    Args:
        velocities: [M, 3] of active Gaussians, per clip length.
        rows: [M] int64, which Gaussians they are; for the Triton kernels -1 = padding.
        neighbours: of all Gaussians.
        count: how many of the rows are not padding for ours; the number of all Gaussians for the paper's. A tensor where only the
            device knows it.
    """
    twin = import_module(f"flowsplat.training.rigidity.{devices.kernels_for(velocities)}")
    return twin.rigid_loss(velocities, rows, neighbours, count)
