"""Line up the motion models that are compared, each with all other settings of preset ``default``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flowsplat.common.errors import InputError
from flowsplat_benchmarks.ablations.variants import Variant


@dataclass(frozen=True)
class Entrant:
    """A motion model.

    Attributes:
        variant: how it is trained.
        paper: whose motion it is.
        limits: what it cannot do here, or does otherwise than its paper.
    """

    variant: Variant
    paper: str
    limits: str = ""


def _entrant(kind: str, paper: str, limits: str = "") -> Entrant:
    return Entrant(Variant(kind, f"{kind}: {paper}", {"model.kind": kind}), paper, limits)


BASE = Entrant(Variant("series", "series: Flow Splatting, ours"), "Flow Splatting")
"""What the others are compared with: the model of preset ``default``."""
LINEUP = (
    BASE,
    _entrant(
        "linear", "4DGS",
        "a straight line and no rotation in time; the background has no brightness inside a Gaussian, as it has no axes of its own",
    ),
    _entrant("splines", "SplineGS", "all Gaussians have as many control points: none is pruned"),
    _entrant(
        "marbles", "Dynamic Gaussian Marbles",
        "round Gaussians, of the background too, without brightness inside; the rigid loss of all models holds groups together",
    ),
    _entrant("bases", "Shape of Motion", "motion is that of the bases: a Gaussian has none of its own"),
    _entrant("hexplane", "4D Gaussians", "scales do not change in time; Gaussians fade in it as those of all models"),
    _entrant(
        "deformation", "Deformable 3D Gaussians",
        "a network of 4 layers of 64, not 8 of 256, which two cores cannot do; scales do not change in time, Gaussians fade in it",
    ),
)  # fmt: skip
"""All models, the base first."""


def choose_entrants(names: Sequence[str], with_base: bool = True) -> list[Entrant]:
    """Return the models of these names, or all of them.

    Args:
        with_base: whether the base is always among them.

    Raises:
        InputError: there is no such model.
    """
    known = [entrant.variant.name for entrant in LINEUP]
    for name in names:
        if name not in known:
            raise InputError(f"There is no model {name!r}: choose from {', '.join(known)}.")
    return [entrant for entrant in LINEUP if not names or (with_base and entrant is BASE) or entrant.variant.name in names]
