"""Estimate how far away an object is: a posterior over ln s from everything that ties it to the still world.

Frames of one camera leave one number open for every object, its distance at a time of one's choice; scaling it about the
camera changes no image. Each cue that ties it to the world has its own noise, a gate, and a chance to be wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

GRID_STEP, GRID_NEAR, GRID_FAR = 0.005, -3.0, 3.0
"""The grid of ln s about the guess. Chosen by eye."""
GUESS_SIGMA, GUESS_TAIL_SIGMA, GUESS_TAIL_SHARE = 0.25, 1.2, 0.4
"""Of the guess that every object has, where the scene behind it ends: its standard deviation, mostly, and that of the rest.
Chosen by eye."""
GROUND_SIGMA = 0.25
"""Of the guess by where it would touch the ground. Chosen by eye."""
BOUND_SOFTNESS, BOUND_WRONG_CHANCE = 0.03, 0.02
"""How sharply a far bound cuts, and its chance to be wrong. Chosen by eye."""


@dataclass(frozen=True)
class Cue:
    """What one cue says about ln s.

    Attributes:
        log_scale: its value.
        sigma: standard deviation.
        wrong: chance that it has nothing to do with the truth.
    """

    log_scale: float
    sigma: float
    wrong: float


@dataclass(frozen=True)
class Distance:
    """The posterior.

    Attributes:
        log_scale: median of ln s. A chance that the cues are wrong lies on one side of a bound: it would move the mean.
        sigma: standard deviation.
    """

    log_scale: float
    sigma: float


def combine(guess: float, cues: Mapping[str, Cue], bounds: Sequence[float], near_ground: float | None = None) -> Distance:
    """Return the median and standard deviation of the whole posterior of ln s.

    Args:
        guess: ln s if nothing else is known.
        cues: those that passed their gates.
        bounds: ln s beyond which the object would be behind what it hides.
        near_ground: ln s a little nearer than where it would touch the ground.
    """
    told = [guess, *(cue.log_scale for cue in cues.values()), *([] if near_ground is None else [near_ground])]
    x = np.arange(min(told) + GRID_NEAR, max(told) + GRID_FAR, GRID_STEP)
    width = GRID_FAR - GRID_NEAR
    log_p = np.log(_guess_density(x, guess, GUESS_SIGMA))
    if near_ground is not None:
        log_p += np.log(_guess_density(x, near_ground, GROUND_SIGMA))
    for cue in cues.values():
        log_p += np.log((1 - cue.wrong) * _student_density(x, cue.log_scale, cue.sigma, 4) + cue.wrong / width)
    for bound in bounds:
        inside = 1 / (1 + np.exp(np.clip((x - bound) / BOUND_SOFTNESS, -50, 50)))
        log_p += np.log((1 - BOUND_WRONG_CHANCE) * inside + BOUND_WRONG_CHANCE)
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    median = float(np.interp(0.5, np.cumsum(p), x))
    return Distance(median, float(np.sqrt((p * (x - median) ** 2).sum())))


def _guess_density(x: np.ndarray, mean: float, sigma: float) -> np.ndarray:
    return (1 - GUESS_TAIL_SHARE) * _student_density(x, mean, sigma, 4) + GUESS_TAIL_SHARE * _student_density(
        x, mean, GUESS_TAIL_SIGMA, 4
    )


def _student_density(x: np.ndarray, mean: float, sigma: float, freedom: int) -> np.ndarray:
    """Return the density of Student's t; its constant for 3 and 4 degrees of freedom is nearly the same."""
    return 0.37 / sigma * (1 + ((x - mean) / sigma) ** 2 / freedom) ** (-(freedom + 1) / 2)
