"""What two things cost that are cut apart: the log odds that they are one object, a logistic function of what tells of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json

WEIGHTS = Path(__file__).with_name("weights.json")
"""Written by ``python -m flowsplat_benchmarks.scripts.identity``, which says what it was fitted on."""
MAX_STANDARDIZED = 4.0
"""Standard deviations beyond which a feature tells no more."""
MAX_LOG_ODDS = 5.0
"""Largest log odds."""


@dataclass(frozen=True)
class Cost:
    """A logistic function of features and of the products of any two of them.

    Attributes:
        mean, deviation: [F] of the features where it was fitted.
        weights: of the features, their products, and 1.
    """

    mean: np.ndarray
    deviation: np.ndarray
    weights: np.ndarray

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Log odds [E] that those with these features [E, F] are one object."""
        return np.clip(expand((features - self.mean) / self.deviation) @ self.weights, -MAX_LOG_ODDS, MAX_LOG_ODDS)


@dataclass(frozen=True)
class Costs:
    """Those of tracks, and of fragments of tracks.

    Attributes:
        bias: log odds that are added to those of tracks: below 0, fragments are rather too small than of two objects.
    """

    tracks: Cost
    bias: float
    fragments: Cost


def expand(standardized: np.ndarray) -> np.ndarray:
    """Features [E, F], all products of two of them, and 1."""
    z = np.clip(standardized, -MAX_STANDARDIZED, MAX_STANDARDIZED)
    products = [z[:, i] * z[:, j] for i, j in combinations_with_replacement(range(z.shape[1]), 2)]
    return np.column_stack([z, *products, np.ones(len(z))])


def make_costs(values: Mapping[str, Any], features: Mapping[str, Sequence[str]]) -> Costs:
    """What ``weights.json`` holds.

    Args:
        features: the names of those of ``tracks`` and ``fragments`` that are computed.

    Raises:
        InputError: it was fitted to other features.
    """
    found = {}
    for name, names in features.items():
        if values[name]["features"] != list(names):
            raise InputError(f"{WEIGHTS.name}: {name} have other features; run python -m flowsplat_benchmarks.scripts.identity.")
        found[name] = Cost(*(np.array(values[name][key], float) for key in ("mean", "deviation", "weights")))
    return Costs(found["tracks"], float(values["bias"]), found["fragments"])


@cache
def read_weights() -> dict[str, Any]:
    """The package's own."""
    values: dict[str, Any] = read_json(WEIGHTS)
    return values
