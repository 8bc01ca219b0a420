"""Which Gaussians a scene can do without: those without which its training frames change least (docs/method/training.md)."""

from __future__ import annotations

import torch
from torch import Tensor

from flowsplat.gaussians.contribution import compute_contributions
from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.observations import Observations

_OBJECT_NUMBERS = 256
"""Numbers that an object can have, and 0 of what is none (``Gaussians4D.object_ids``)."""


def rank_by_need(gaussians: Gaussians4D, observations: Observations, seed: int) -> Tensor:
    """Return [N] float64 how much is lost with each Gaussian and all of its part that are needed less.

    A part is an object, or the background. What is lost is the sum of the squared changes of the training frames without each, as a
    share of the squared error that they have in the pixels of that part: so a small object keeps as much of its quality as the
    background does. Gaussians with less than x can go where x of the error may be added; that changes add up is a guess, which
    training on makes good.

    Args:
        gaussians: the model.
        observations: the training frames; pixels where something is burnt in do not count.
        seed: of the random signs of the estimate.
    """
    generator = torch.Generator().manual_seed(seed)
    changes = torch.zeros(len(gaussians), dtype=torch.float64, device=gaussians.device)
    errors = torch.zeros(_OBJECT_NUMBERS, dtype=torch.float64, device=gaussians.device)
    shown = None if observations.overlay is None else torch.from_numpy(~observations.overlay)
    for frame in observations.frames:
        found = compute_contributions(gaussians, frame.camera, frame.time, generator, shown)
        changes.index_add_(0, found.rows, found.changes.double())
        target, numbers = torch.from_numpy(frame.image).to(found.image), torch.from_numpy(frame.object_ids)
        error = ((found.image - target / 255) ** 2).sum(-1)
        if shown is not None:
            error = error * shown.to(error)
        errors.index_add_(0, numbers.flatten().to(error.device, torch.int64), error.flatten().double())
    return _share_of_part(changes, torch.where(gaussians.dynamic, gaussians.object_ids, 0), errors)


def _share_of_part(changes: Tensor, numbers: Tensor, errors: Tensor) -> Tensor:
    """Return [N] the sum of the changes up to each, in rising order within its part, by the error of that part."""
    lost = torch.empty_like(changes)
    for number in torch.unique(numbers).tolist():
        rows = torch.nonzero(numbers == number).squeeze(1)
        ordered, order = torch.sort(changes[rows], stable=True)
        # A part in whose pixels there is no error, or that has none, keeps all that changes anything.
        lost[rows[order]] = torch.cumsum(ordered, 0) / errors[number].clamp(min=1e-12)
    return lost


def choose_needed(lost: Tensor, share: float, most: int) -> Tensor:
    """Return the rows, rising, of the Gaussians that stay; the neediest one at least.

    Args:
        lost: from ``rank_by_need``.
        share: of the error, that may be added.
        most: how many may stay.
    """
    needed = torch.sort(lost, descending=True, stable=True).indices
    count = int((lost >= share).sum())
    return needed[: max(1, min(count, most))].sort().values
