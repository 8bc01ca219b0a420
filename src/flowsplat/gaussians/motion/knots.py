"""Interpolate between knots that are spread evenly over the clip: the weights that they have at a time, and their rates."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

WeighKnots = Callable[[Tensor, int], tuple[Tensor, Tensor]]
FIT_AT_A_TIME = 8192
"""Gaussians whose knots are fitted at a time, for the memory. Chosen by eye."""
PATH_SIGMAS = (-1.5, -1.0, -0.5, 0.5, 1.0, 1.5)
"""At which times from its center, in standard deviations of its presence, a path that is fitted is asked for. Chosen by eye."""
BEND_WEIGHT = 1e-2
"""What the squares of the second differences of the knots count in that fit, relative to the path: where it says nothing the knots
go on straight. Chosen by eye."""


def cubic_weights(t: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the weights of the ``count`` control points of a uniform cubic B-spline at clip times, and their rates.

    Its pieces are even over the clip; before and after it the first and the last go on. (de Boor, *A Practical Guide to Splines*,
    chapter IX: u^3 / 6 and its three neighbors.)

    Args:
        t: [...] clip times.
        count: 4 or more.

    Returns:
        [..., count] each; the rates per clip length.
    """
    pieces = count - 3
    first, u = _locate(t, pieces)
    weights = [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3]
    rates = [-3 * (1 - u) ** 2, 9 * u**2 - 12 * u, -9 * u**2 + 6 * u + 3, 3 * u**2]
    return _scatter(first, weights, count) / 6, _scatter(first, rates, count) * (pieces / 6)


def linear_weights(t: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The same of ``count`` points (2 or more) that are joined by straight lines, the first at 0 and the last at 1."""
    first, u = _locate(t, count - 1)
    ones = torch.ones_like(u)
    return _scatter(first, [1 - u, u], count), _scatter(first, [-ones, ones], count) * (count - 1)


def _locate(t: Tensor, pieces: int) -> tuple[Tensor, Tensor]:
    """Return [...] int64 the piece of each time, and how far it is in it."""
    place = t * pieces
    first = place.detach().floor().clamp(0, pieces - 1)
    return first.long(), place - first


def _scatter(first: Tensor, values: list[Tensor], count: int) -> Tensor:
    """Return [..., count] the values at as many places from ``first`` on, and 0 elsewhere."""
    places = first[..., None] + torch.arange(len(values), device=first.device)
    stacked = torch.stack(values, -1)
    return stacked.new_zeros(*first.shape, count).scatter(-1, places, stacked)


def fit_knots(weigh: WeighKnots, times: Tensor, sigmas: Tensor, coefficients: Tensor, count: int) -> Tensor:
    """Return [N, count, 3] knots that follow paths about their own times, by least squares.

    Args:
        weigh: ``cubic_weights`` or ``linear_weights``.
        times: [N] center times.
        sigmas: [N] for how long the path of each is known, clip time.
        coefficients: [N, order, 3] a_n of the path sum a_n tau^n; order may be 0.
        count: knots.
    """
    knots, moving = coefficients.new_zeros(len(times), count, 3), torch.nonzero(coefficients.flatten(1).any(1)).squeeze(1)
    for rows in moving.split(FIT_AT_A_TIME) if len(moving) else ():
        knots[rows] = _fit_some(weigh, times[rows], sigmas[rows], coefficients[rows], count)
    return knots


def _fit_some(weigh: WeighKnots, times: Tensor, sigmas: Tensor, coefficients: Tensor, count: int) -> Tensor:
    sides = torch.tensor(PATH_SIGMAS, dtype=torch.float64, device=times.device)
    spans = sigmas.double()[:, None] * sides
    powers = torch.stack([spans ** (n + 1) for n in range(coefficients.shape[1])], -1)
    paths = powers @ coefficients.double()
    at = times.double()[:, None]
    design = weigh(at + spans, count)[0] - weigh(at, count)[0]
    bends = torch.eye(count, dtype=torch.float64, device=times.device).diff(n=2, dim=0)
    # A path says nothing of the mean of the knots, and neither do bends: it is 0, whatever weight that has. Their slope is left to
    # the path alone; a weight on the values would take from it the more, the shorter it is known.
    mean = torch.full_like(design[:1, :1, :], 1 / count)
    normal = design.transpose(1, 2) @ design + BEND_WEIGHT * bends.T @ bends + mean.transpose(1, 2) @ mean
    return torch.linalg.solve(normal, design.transpose(1, 2) @ paths).to(coefficients)
