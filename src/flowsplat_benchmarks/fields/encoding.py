"""Encode coordinates by sines and cosines of rising frequency, of which the high ones can come in one after the other."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def count_encoded(numbers: int, octaves: int) -> int:
    """Return how many numbers ``encode`` makes of ``numbers``."""
    return numbers * (1 + 2 * octaves)


def weigh_octaves(count: int, octaves: float) -> Tensor:
    """Return [count] float64 weights between 0 and 1 of the frequencies: the first ``octaves`` of them count.

    Park et al. 2021 (Nerfies, https://arxiv.org/abs/2011.12948), equation 8.

    >>> weigh_octaves(3, 1.5).tolist()
    [1.0, 0.5, 0.0]
    """
    k = torch.arange(count, dtype=torch.float64)
    return (0.5 * (1 - torch.cos(math.pi * (octaves - k).clamp(0, 1)))).round(decimals=12)


def encode(values: Tensor, count: int, octaves: float | None = None, has_values: bool = True) -> Tensor:
    """Return the values and the sines and cosines of 2^k times them, for k below ``count``.

    Mildenhall et al. 2020 (NeRF, https://arxiv.org/abs/2003.08934), equation 4, without the factor pi, as Nerfies has it.

    Args:
        values: [..., D].
        count: of frequencies.
        octaves: how many of them count (``weigh_octaves``); None = all.
        has_values: whether the values themselves count; without them, there are zeros in their place.

    Returns:
        [..., D (1 + 2 count)].
    """
    phases = values[..., None] * 2.0 ** torch.arange(count, dtype=values.dtype, device=values.device)
    sines, cosines = torch.sin(phases), torch.cos(phases)
    if octaves is not None:
        weights = weigh_octaves(count, octaves).to(values)
        sines, cosines = weights * sines, weights * cosines
    first = values if has_values else torch.zeros_like(values)
    return torch.cat([first, sines.flatten(-2), cosines.flatten(-2)], -1)
