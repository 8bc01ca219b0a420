"""How far training pixels are from being covered: what long training would let open. Ours (METHOD 7)."""

from __future__ import annotations

from torch import Tensor

OPEN_FROM = 0.3
"""Transmittance that costs nothing. Less than ``render.FILLED_FROM``, from which on rendering fills."""


def openness(alpha: Tensor) -> Tensor:
    """Mean transmittance above ``OPEN_FROM``, a scalar, differentiable in alpha [H, W].

    Black shines through an open pixel, so a dark surface need not be opaque and, in some thousand steps, does not stay it.
    Rendering would take it for a pixel that nothing covers and fill it from its neighbours.
    """
    return (1 - OPEN_FROM - alpha).clamp(min=0).mean()
