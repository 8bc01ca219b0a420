"""The rigid loss, and the one place that picks who computes it."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from flowsplat.common import devices
from flowsplat.common.devices import Kernels
from flowsplat.training.rigidity.neighbors import Neighbors


class RigidLossKernels(Protocol):
    """What each of the twins has."""

    def rigid_loss(self, velocities: Tensor, rows: Tensor, neighbors: Neighbors, count: int | Tensor) -> Tensor:
        """As below."""


def _twin(kernels: Kernels) -> RigidLossKernels:
    """Pick the backend that computes it, imported only where that is needed."""
    if kernels == "cpu":
        from flowsplat.training.rigidity import cpu

        return cpu
    if kernels == "triton":
        from flowsplat.training.rigidity import triton

        return triton
    from flowsplat.training.rigidity import reference

    return reference


def rigid_loss(velocities: Tensor, rows: Tensor, neighbors: Neighbors, count: int | Tensor) -> Tensor:
    """L_rigid = 1 / (k count) sum_i sum_j w_ij |v_i - v_j| over the pairs that are both active, the norm safe at 0
    (docs/method/training.md).

    Args:
        velocities: [M, 3] of active Gaussians, per clip length.
        rows: [M] int64, which Gaussians they are; for the Triton kernels -1 = padding.
        neighbors: of all Gaussians.
        count: how many of the rows are not padding for ours; the number of all Gaussians for the paper's. A tensor where only the
            device knows it.
    """
    return _twin(devices.kernels_for(velocities)).rigid_loss(velocities, rows, neighbors, count)
