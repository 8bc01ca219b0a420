"""Find the neighbors of Gaussians for the rigid loss: found once for many steps, at each Gaussian's own center time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from flowsplat.gaussians.gaussians4d import Gaussians4D


@dataclass(frozen=True)
class Neighbors:
    """The nearest neighbors of N Gaussians.

    A Gaussian lives for a few frames, and its neighbors at its center time are its neighbors in all of them; the loss
    counts a pair where both are active. A search in every frame, every time, would take longer than all the rest of a step.

    Attributes:
        indices: [N, k] int32; -1 where there is none.
        weights: [N, k] float32, exp(-beta distance), 0 where there is none.
    """

    indices: Tensor
    weights: Tensor

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def alone(self) -> Tensor:
        """[N] bool: they have none."""
        return (self.indices < 0).all(1)

    @cached_property
    def incoming(self) -> tuple[Tensor, Tensor]:
        """The pairs the other way round: offsets [N + 1] int64 into pairs int32, which number the entries of ``indices``.

        With them the gradient of a Gaussian is a sum in a fixed order, whatever the threads do.
        """
        flat = self.indices.flatten()
        # Counting from 1, so that the missing ones, -1, count too and come first.
        counts = torch.bincount(flat + 1, minlength=len(self) + 1)
        pairs = torch.argsort(flat, stable=True)[int(counts[0]) :].to(torch.int32)
        return torch.cumsum(counts, 0) - counts[0], pairs

    def reindex(self, index: Tensor) -> Neighbors:
        """After density control: row i comes from old row ``index[i]``; of several copies the first one stays a neighbor."""
        device = index.device
        new = torch.full((len(self) + 1,), len(index), device=device)
        new.scatter_reduce_(0, index, torch.arange(len(index), device=device), "amin")
        new[new == len(index)] = -1
        indices = new[self.indices[index].long()].to(torch.int32)
        return Neighbors(indices, torch.where(indices >= 0, self.weights[index], 0))


@torch.no_grad()
def find_neighbors(gaussians: Gaussians4D, times: Sequence[float], k: int, beta: float, dynamic_only: bool) -> Neighbors:
    """Return the k nearest neighbors of every Gaussian that moves, among those active in the frame nearest to its center time.

    Args:
        gaussians: where they are.
        times: [T] clip times of the frames.
        k: how many.
        beta: weights are exp(-beta distance).
        dynamic_only: neighbors and neighbored are dynamic ones alone.
    """
    count, device = len(gaussians), gaussians.device
    indices, weights = torch.full((count, k), -1, dtype=torch.int32, device=device), torch.zeros(count, k, device=device)
    frames = torch.as_tensor(np.asarray(times, np.float32), device=device)
    middles = 0.5 * (frames[1:] + frames[:-1])
    nearest = torch.bucketize(gaussians.params["times"], middles)
    needed = ["means", "times", *gaussians.motion.parameters]  # What they look like, which is half of what they are, is no matter.
    for frame, t in enumerate(times):
        active = gaussians.active(t)
        rows = active.rows[active.num_static :]
        if dynamic_only:
            rows = rows[gaussians.dynamic[rows]]
        wanted = nearest[rows] == frame
        if len(rows) < 2 or not bool(wanted.any()):
            continue
        chosen = {name: gaussians.params[name][rows] for name in needed}
        means = gaussians.motion.state(chosen, t).means.cpu().numpy()
        found = min(k, len(rows) - 1)
        distances, others = cKDTree(means).query(means[wanted.cpu().numpy()], k=found + 1, workers=-1)
        own = rows[wanted]
        # All but itself, which need not come first: a clone lies where its twin does.
        itself = others == np.flatnonzero(wanted.cpu().numpy())[:, None]
        itself[~itself.any(1), -1] = True
        others, distances = others[~itself].reshape(-1, found), distances[~itself].reshape(-1, found)
        indices[own, :found] = rows[torch.from_numpy(others).to(device)].to(torch.int32)
        weights[own, :found] = torch.from_numpy(np.exp(-beta * distances).astype(np.float32)).to(device)
    return Neighbors(indices, weights)
