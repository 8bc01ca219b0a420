"""Does a difference that was measured bear out what was claimed of it?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

Verdict = Literal["confirmed", "contradicted", "not separable", "no difference", "one run"]
Run = tuple[str, int]
"""Which run of a variant: its scene and its seed."""

EVEN_DECIBELS = 0.05
"""Decibels of PSNR that are not visible, and that another seed changes as well."""


@dataclass(frozen=True)
class Effect:
    """The differences of a variant from its base.

    Attributes:
        differences: of runs on the same scene with the same seed, by run.
        mean: over the seeds of every scene, then over the scenes.
        spread: standard deviation of the single differences over seeds and scenes; None for fewer than two.
    """

    differences: Mapping[Run, float]
    mean: float
    spread: float | None

    def of_scene(self, scene: str) -> float | None:
        """Return the mean over the seeds of one scene; None where there is none."""
        values = [value for run, value in self.differences.items() if run[0] == scene]
        return float(np.mean(values)) if values else None


def effect(variant: Mapping[Run, float], base: Mapping[Run, float]) -> Effect | None:
    """Compare what both have in common; None where that is nothing.

    Args:
        variant: a figure by run.
        base: the same figure of what it is compared with.
    """
    differences = {key: value - base[key] for key, value in variant.items() if key in base}
    if not differences:
        return None
    scenes = dict.fromkeys(run[0] for run in differences)
    means = [np.mean([value for run, value in differences.items() if run[0] == scene]) for scene in scenes]
    spread = float(np.std(list(differences.values()), ddof=1)) if len(differences) > 1 else None
    return Effect(differences, float(np.mean(means)), spread)


def verdict(found: Effect, expected: int) -> Verdict:
    """Judge a claim by the mean difference and its spread over seeds and scenes.

    A mean and a spread below ``EVEN_DECIBELS`` are *no difference*, whatever was claimed. Else a mean up to its spread is *not
    separable*. A larger one *confirms* a claim of the same sign and *contradicts* any other, also that there were no difference.
    *One run* has no spread and tells nothing.

    Args:
        expected: the sign of the difference that was claimed: -1, 0 (none) or 1.

    >>> runs = {("bear", 0): -0.5, ("bear", 1): -0.6, ("train", 0): -0.4}
    >>> verdict(effect(runs, dict.fromkeys(runs, 0.0)), -1)
    'confirmed'
    """
    if found.spread is None:
        return "one run"
    if max(abs(found.mean), found.spread) < EVEN_DECIBELS:
        return "no difference"
    if abs(found.mean) <= found.spread:
        return "not separable"
    return "confirmed" if np.sign(found.mean) == np.sign(expected) else "contradicted"


def counts(verdicts: Sequence[Verdict]) -> str:
    """Return how many of each, in a sentence."""
    return ", ".join(f"{verdicts.count(kind)} {kind}" for kind in get_args(Verdict))
