"""Gaussians that share the place of one and look together as it did: 3D Gaussian Splatting as Markov Chain Monte Carlo
(Kheradmand et al. 2024, https://arxiv.org/abs/2404.09591)."""

from __future__ import annotations

from torch import Tensor

MAX_SHARERS = 51
"""Gaussians that may share the place of one in a round (gsplat 1.5, ``binoms``)."""


def share_place(opacities: Tensor, sharers: Tensor, max_sharers: int = MAX_SHARERS) -> tuple[Tensor, Tensor]:
    """Return how opaque each of several Gaussians in one place is, and how many times as large, so that they look as the one did.

    That is eq. 9 of the paper: 1 - (1 - o')^N = o, and the same integral along the ray; its double sum over binomials is summed up
    over one of its indices (sum_i C(i, k) = C(N, k + 1)).

    Args:
        opacities: [N] of the one.
        sharers: [N] int, how many there are.
        max_sharers: more count as so many.
    """
    count = sharers.clamp(1, max_sharers).double()
    old = opacities.double()
    new = 1 - (1 - old) ** (1 / count)
    total, binomial, power = new.new_zeros(new.shape), count.clone(), new.clone()
    for k in range(int(count.max()) if len(count) else 0):
        total += (-1) ** k / (k + 1) ** 0.5 * binomial * power
        binomial, power = binomial * (count - k - 1).clamp(min=0) / (k + 2), power * new
    return new.to(opacities.dtype), (old / total).to(opacities.dtype)
