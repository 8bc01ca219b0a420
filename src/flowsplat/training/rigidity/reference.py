"""The oracle of the rigid loss, in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from flowsplat.training.rigidity.neighbors import Neighbors

NORM_EPSILON = 1e-12
"""Added to squared norms, which have no gradient at 0 otherwise. Chosen by eye."""


def rigid_loss(velocities: Tensor, rows: Tensor, neighbors: Neighbors, count: int | Tensor) -> Tensor:
    """See ``api.rigid_loss``."""
    place = torch.full((len(neighbors) + 1,), -1, device=rows.device)  # the last one is where the missing neighbor, -1, points to
    place[rows] = torch.arange(len(rows), device=rows.device)
    others = place[neighbors.indices[rows].long()]
    difference = velocities[:, None] - velocities[others.clamp(min=0)]
    norm = torch.sqrt((difference * difference).sum(-1) + NORM_EPSILON)
    weights = neighbors.weights[rows].to(norm.dtype) * (others >= 0)
    return (weights * norm).sum() / (neighbors.indices.shape[1] * count)
