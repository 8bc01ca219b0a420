"""Render a field along rays: samples in strata, more of them where something is, and the sum of what they emit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from flowsplat_benchmarks.fields.rays import Rays

Ask = Callable[[Tensor, Tensor, Tensor, bool], tuple[Tensor, Tensor]]
"""A field: (points [N, S, 3], views [N, 3], times [N], fine) to density [N, S] and color [N, S, 3]."""

MIN_WEIGHT = 1e-5
"""Added to the weight of every interval, so that the samples of a ray that met nothing are spread over it. That of NeRF."""
END_LENGTH = 1e10
"""Length of the last interval, which is that of everything behind the last sample. That of NeRF."""


@dataclass(frozen=True)
class Composite:
    """What is seen along rays.

    Attributes:
        color: [N, 3], black where nothing is.
        alpha: [N] between 0 and 1.
        depth: [N] planar depth times alpha.
        weights: [N, S] of the samples.
    """

    color: Tensor
    alpha: Tensor
    depth: Tensor
    weights: Tensor


def place_strata(near: float, far: float, rays: int, count: int, generator: torch.Generator | None) -> Tensor:
    """Return [rays, count] depths, rising, one in each of ``count`` strata that are equal in inverse depth.

    Inverse depth, because a clip out of doors goes far: even depths would leave what is near with a few samples.

    Args:
        near, far: planar depths, above 0.
        generator: of the place in a stratum; None = its middle.
    """
    places = torch.full((rays, count), 0.5) if generator is None else torch.rand((rays, count), generator=generator)
    shares = (torch.arange(count) + places) / count
    return 1 / ((1 - shares) / near + shares / far)


def place_importance(depths: Tensor, weights: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """Return [N, S + count] depths, rising: the given ones, and samples of the density that the weights have along a ray.

    Mildenhall et al. 2020 (https://arxiv.org/abs/2003.08934), section 5.2: constant between the middles of two samples, found by
    inverting the sum of the weights.

    Args:
        depths: [N, S], rising, with S of 3 or more.
        weights: [N, S].
        generator: of the samples; None = evenly.
    """
    edges = 0.5 * (depths[:, 1:] + depths[:, :-1])
    inner = weights[:, 1:-1].detach() + MIN_WEIGHT
    sums = torch.cumsum(inner / inner.sum(1, keepdim=True), 1)
    sums = torch.cat([torch.zeros_like(sums[:, :1]), sums], 1)
    places = torch.full((len(depths), count), 0.5) if generator is None else torch.rand((len(depths), count), generator=generator)
    shares = ((torch.arange(count) + places) / count).to(depths)
    after = torch.searchsorted(sums, shares.contiguous(), right=True).clamp(1, sums.shape[1] - 1)
    low, high = (torch.gather(sums, 1, after - 1), torch.gather(sums, 1, after))
    start, end = torch.gather(edges, 1, after - 1), torch.gather(edges, 1, after)
    within = ((shares - low) / (high - low).clamp_min(1e-12)).clamp(0, 1)
    return torch.sort(torch.cat([depths, start + within * (end - start)], 1), 1).values


def composite(density: Tensor, color: Tensor, depths: Tensor, stretch: Tensor, end: float = END_LENGTH) -> Composite:
    """Return what is seen, with density and color constant from each sample to the next one.

    Max 1995 (https://doi.org/10.1109/2945.468400), as NeRF, equation 3, has it.

    Args:
        density: [N, S] per unit of length.
        color: [N, S, 3].
        depths: [N, S] planar, rising.
        stretch: [N] length of a ray per planar depth.
        end: planar depth behind the last sample that it stands for.
    """
    steps = torch.cat([depths[:, 1:] - depths[:, :-1], torch.full_like(depths[:, :1], end)], 1)
    optical = density * steps * stretch[:, None]
    # Summed before the last one is added: what END_LENGTH makes of it leaves no digits of the others.
    before = torch.cat([torch.zeros_like(optical[:, :1]), torch.cumsum(optical[:, :-1], 1)], 1)
    weights = torch.exp(-before) * -torch.expm1(-optical)
    return Composite((weights[..., None] * color).sum(1), weights.sum(1), (weights * depths).sum(1), weights)


def render_rays(
    ask: Ask, rays: Rays, near: float, far: float, samples: int, importance: int, generator: torch.Generator | None = None
) -> tuple[Composite, Composite]:
    """Return what the coarse and the fine template of a field show along rays.

    Args:
        ask: the field.
        rays: N of them.
        near, far: planar depths between which it is asked.
        samples: along a ray, for the coarse template.
        importance: more of them for the fine one.
        generator: of their places; None = none is random.
    """
    stretch = rays.directions.norm(dim=1)
    views = rays.directions / stretch[:, None]

    def show(depths: Tensor, fine: bool) -> Composite:
        points = rays.origins[:, None] + depths[..., None] * rays.directions[:, None]
        density, color = ask(points, views, rays.times, fine)
        return composite(density, color, depths, stretch)

    depths = place_strata(near, far, len(stretch), samples, generator).to(rays.origins)
    coarse = show(depths, False)
    return coarse, show(place_importance(depths, coarse.weights, importance, generator), True)
