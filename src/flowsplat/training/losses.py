"""The losses of METHOD 5 besides the colour loss."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor


def flow_loss(flow: Tensor, alpha: Tensor, target: Tensor, valid: Tensor, divide_by_alpha: bool) -> Tensor:
    """L1 in pixels between splatted and prior flow, mean over valid pixels and both components.

    Args:
        flow: [H, W, 2] premultiplied by alpha.
        alpha: [H, W]
        target: [H, W, 2]
        valid: [H, W] bool.
        divide_by_alpha: ours: compare V with alpha F where alpha >= 0.5, which is |V / alpha - F| weighted by alpha and has no
            division to explode. Off, the paper's: compare V with F.
    """
    if divide_by_alpha:
        target = alpha[..., None] * target
        valid = valid & (alpha >= 0.5)
    error = (flow - target).abs().sum(-1)
    return (error * valid).sum() / (2 * valid.sum().clamp(min=1))


def depth_loss(depth: Tensor, alpha: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Ours: relative L1 between splatted [H, W] (premultiplied) and prior depth [H, W], mean over all pixels."""
    error = (depth - alpha * target).abs() / target
    return (error * valid).sum() / error.numel()


def rigid_neighbours(means: np.ndarray, k: int, beta: float) -> tuple[Tensor, Tensor]:
    """The k nearest neighbours [A, k] of every Gaussian and their weights exp(-beta distance) [A, k], both detached."""
    k = min(k, len(means) - 1)
    distances, neighbours = cKDTree(means).query(means, k=k + 1, workers=-1)
    weights = np.exp(-beta * distances[:, 1:]).astype(np.float32)
    return torch.from_numpy(neighbours[:, 1:].copy()), torch.from_numpy(weights)


class _RigidLoss(torch.autograd.Function):
    """Its own gradient: torch adds the gradients of gathered rows up in whatever order its threads come, which no run repeats."""

    @staticmethod
    def forward(ctx: Any, velocities: Tensor, neighbours: Tensor, weights: Tensor, count: int) -> Tensor:
        difference = velocities[:, None] - velocities[neighbours]
        norm = torch.sqrt((difference * difference).sum(-1) + 1e-12)
        share = weights / (neighbours.shape[1] * count)
        ctx.save_for_backward(difference * (share / norm)[..., None], neighbours)
        return (share * norm).sum()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:  
        pull, neighbours = ctx.saved_tensors
        index, back = neighbours.numpy().ravel(), np.empty((len(pull), 3))
        for axis in range(3):
            back[:, axis] = np.bincount(index, pull[..., axis].numpy().ravel(), minlength=len(pull))
        return grad * (pull.sum(1) - torch.from_numpy(back).to(pull.dtype)), None, None, None


def rigid_loss(velocities: Tensor, neighbours: Tensor, weights: Tensor, count: int) -> Tensor:
    """L_rigid = 1 / (k count) sum_i sum_j w_ij |v_i - v_j|, the norm safe at 0.

    Args:
        velocities: [A, 3] per clip length.
        neighbours: [A, k] int64.
        weights: [A, k]
        count: A for ours; the number of all Gaussians for the paper's.
    """
    result: Tensor = _RigidLoss.apply(velocities, neighbours, weights, count)
    return result
