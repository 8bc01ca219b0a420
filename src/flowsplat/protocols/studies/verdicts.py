"""Does a difference that was measured bear out what was claimed of it?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

Verdict = Literal["confirmed", "contradicted", "not separable"]
Run = tuple[Any, ...]
"""Which run: its scene, then what tells the runs on that scene apart (seed, frame-steps)."""

EVEN = 0.1
"""Decibels of PSNR that nobody sees."""


@dataclass(frozen=True)
class Effect:
    """The differences of a variant from its base.

    Attributes:
        differences: of runs on the same scene with the same seed and as many frame-steps, by run.
        mean: over the seeds of every scene, then over the scenes.
        spread: standard deviation of the single differences over seeds and scenes; None for fewer than two.
    """

    differences: Mapping[Run, float]
    mean: float
    spread: float | None

    def of_scene(self, scene: str) -> float | None:
        """Mean over the seeds of one scene; None where there is none."""
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

    A difference below its spread is *not separable*, and so is a single one, whose spread is not known. A larger one *confirms* a
    claim of the same sign and *contradicts* one of the other. That something makes no difference is confirmed by a mean below
    ``EVEN`` and contradicted by a separable one above it.

    Args:
        expected: the sign of the difference that was claimed: -1, 0 (none) or 1.

    >>> runs = {("bear", 0): -0.5, ("bear", 1): -0.6, ("train", 0): -0.4}
    >>> verdict(effect(runs, dict.fromkeys(runs, 0.0)), -1)
    'confirmed'
    """
    if found.spread is None:
        return "not separable"
    separable = abs(found.mean) > found.spread
    if expected == 0:
        if abs(found.mean) < EVEN:
            return "confirmed"
        return "contradicted" if separable else "not separable"
    if not separable:
        return "not separable"
    return "confirmed" if np.sign(found.mean) == np.sign(expected) else "contradicted"


def counts(verdicts: Sequence[Verdict]) -> str:
    """How many of each, in a sentence."""
    kinds: tuple[Verdict, ...] = ("confirmed", "contradicted", "not separable")
    return ", ".join(f"{verdicts.count(kind)} {kind}" for kind in kinds)
