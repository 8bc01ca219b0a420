"""What tells that a pixel moves, weighed by how often it occurs.

Evidence is the logarithm of how much more often moving pixels look like this than those that rest beside them, counted where the
truth is known.

Three counts, one after the other: how the pixel differs from its plates, together with what the matches say; how its light differs
from the plate's, where the plate does not explain it (a shadow only darkens, and leaves the detail); and both together with its
color: what the first two count twice is set right there. Where there is no plate the matches and the color are counted by
themselves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json
from flowsplat.priors.masks.background_plate import PlateComparison

TABLES = Path(__file__).with_name("evidence.json")
"""Written by ``python -m flowsplat_benchmarks.scripts.mask_evidence``, which says what was counted."""

RESIDUAL_KNOTS = (0.15, 0.4, 0.6, 0.85, 1.2, 1.7, 2.4, 3.4, 5.0, 7.5, 11.0)
MOTION_KNOTS = (-14.0, -10.0, -6.0, -3.0, -1.0, 1.0, 3.0, 6.0, 10.0, 14.0)
SUM_KNOTS = (-9.0, -7.0, -5.0, -3.5, -2.0, -1.0, 0.0, 1.0, 2.0, 3.5, 5.0, 7.0, 9.0)
COLOR_KNOTS = (-3.7, -2.2, -1.0, 0.0, 1.0, 2.2, 3.7)
AXES: dict[str, tuple[Sequence[float], ...]] = {
    "plates": (RESIDUAL_KNOTS[1::2], RESIDUAL_KNOTS, MOTION_KNOTS),
    "motion": (MOTION_KNOTS,),
    "light": (
        (-2.2, -1.8, -1.4, -1.05, -0.75, -0.45, -0.15, 0.15, 0.5),
        (0.03, 0.09, 0.16, 0.27, 0.47, 0.8, 1.3),
        (-0.1, 0.15, 0.4, 0.6, 0.75, 0.9),
    ),
    "color": (SUM_KNOTS, COLOR_KNOTS),
    "color without plate": (SUM_KNOTS, COLOR_KNOTS),
}
"""Where each table is known, between which it is linear: differences from the similar and from the middle plate in multiples of
their noise, and summed motion; summed motion where there is no plate; brightness, tint and detail; the sum of these, and the
logarithm to base 2 of how much more often objects have the color than what is round them, with a plate and without."""

UNEXPLAINED = (1.0, 1.8)
"""Multiples of its noise by which a pixel differs from its middle plate, between which the light begins to tell. Chosen by eye."""


@dataclass(frozen=True)
class Tables:
    """The counts, by the names of ``AXES``: logarithms to base 2."""

    log_odds: Mapping[str, np.ndarray]

    def look_up(self, name: str, *values: np.ndarray) -> np.ndarray:
        """Return the logarithms [H, W] float32 for what is measured [H, W]."""
        places = [find_place(value, knots) for value, knots in zip(values, AXES[name], strict=True)]
        return map_coordinates(self.log_odds[name], places, np.float32, order=1)


def weigh_plates(tables: Tables, found: PlateComparison, motion: np.ndarray) -> np.ndarray:
    """Return log odds [H, W] float32 that a pixel moves, from its plates, where it has some, and from its motion [H, W]."""
    beside = tables.look_up("plates", found.similar, found.median, motion) + weigh_light(tables, found)
    return np.where(found.similar >= 0, beside, tables.look_up("motion", motion))


def weigh_color(tables: Tables, evidence: np.ndarray, color: np.ndarray, has_plate: np.ndarray) -> np.ndarray:
    """Return log odds [H, W] float32 from those of plates and motion, from how much likelier objects have the color, both [H, W],
    and from where there is a plate, [H, W] bool."""
    both = tables.look_up("color", evidence, color), tables.look_up("color without plate", evidence, color)
    return np.where(has_plate, *both)


def weigh_light(tables: Tables, found: PlateComparison) -> np.ndarray:
    """Return what the light adds, [H, W] float32."""
    share = np.interp(found.median, UNEXPLAINED, (0, 1)).astype(np.float32)
    return share * tables.look_up("light", found.brightness, found.tint, found.detail)


def find_place(value: np.ndarray, knots: Sequence[float]) -> np.ndarray:
    """Return where values lie among knots: 0 at the first and below, n - 1 at the last and above."""
    return np.interp(value, knots, np.arange(len(knots)))


@cache
def read_tables() -> Tables:
    """The package's own.

    Raises:
        InputError: they were counted at other knots.
    """
    return make_tables(read_json(TABLES))


def make_tables(values: Mapping[str, Any]) -> Tables:
    """What ``evidence.json`` holds."""
    found = {}
    for name, axes in AXES.items():
        if values[name]["knots"] != [list(knots) for knots in axes]:
            raise InputError(f"{TABLES.name}: {name} has other knots; run python -m flowsplat_benchmarks.scripts.mask_evidence.")
        found[name] = np.array(values[name]["log odds"], np.float32)
    return Tables(found)
