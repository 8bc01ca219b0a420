"""List what is claimed of every part of the method: the rows of the paper's three ablation tables, ours, and simpler scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from flowsplat.common.errors import InputError
from flowsplat_benchmarks.ablations.variants import Variant

Group = Literal["representation", "training", "orders", "ours", "baselines"]

TITLES: dict[Group, str] = {
    "representation": "Representation (the paper's table)",
    "training": "Training (the paper's table)",
    "orders": "Orders of the series (the paper's table)",
    "ours": "What we added or chose",
    "baselines": "Simpler scenes with the same priors",
}

FULL = Variant("full", "all of it")
PAPER_ORDERS = Variant(
    "orders-6633", "6, 6; 3, 3 (the paper's)",
    {"model.mean_poly": 6, "model.mean_fourier": 6, "model.quat_poly": 3, "model.quat_fourier": 3},
)  # fmt: skip
NO_GAINS = Variant("no-gains", "no brightness in time", {"model.gains": 0})


@dataclass(frozen=True)
class Claim:
    """A row: what a variant does to PSNR.

    Attributes:
        group: its table.
        variant: what is trained.
        expected: the sign of the claimed difference from ``base``: -1 worse, 0 none, 1 better.
        base: what it is compared with.
        paper: the difference that the paper reports, dB; None where it has none.
        remark: for people.
    """

    group: Group
    variant: Variant
    expected: int
    base: Variant = FULL
    paper: float | None = None
    remark: str = ""


_PAPER_FULL, _PAPER_ORDERS = 28.02, 27.96
"""PSNR of the paper's full setting: it stands with two values in its tables."""


def _from_paper(group: Group, name: str, label: str, changes: Mapping[str, Any], psnr: float, remark: str = "") -> Claim:
    return Claim(group, Variant(name, label, changes), -1, paper=round(psnr - _PAPER_FULL, 2), remark=remark)


def _orders(mean_poly: int, mean_fourier: int, quat_poly: int, quat_fourier: int, psnr: float) -> Claim:
    orders = {
        "model.mean_poly": mean_poly, "model.mean_fourier": mean_fourier, "model.quat_poly": quat_poly,
        "model.quat_fourier": quat_fourier,
    }  # fmt: skip
    name = f"orders-{mean_poly}{mean_fourier}{quat_poly}{quat_fourier}"
    label = f"{mean_poly}, {mean_fourier}; {quat_poly}, {quat_fourier}"
    difference = round(psnr - _PAPER_ORDERS, 2)
    return Claim("orders", Variant(name, label, orders), -1 if difference < 0 else 0, PAPER_ORDERS, difference)


def _ours(name: str, label: str, changes: Mapping[str, Any], expected: int = -1) -> Claim:
    return Claim("ours", Variant(name, label, changes), expected)


CLAIMS: tuple[Claim, ...] = (
    _from_paper(
        "representation", "linear", "neither mu(t) nor q(t): the linear 4D Gaussian",
        {"model.move_means": False, "model.move_quats": False}, 27.17,
    ),
    _from_paper("representation", "no-q", "without q(t): constant rotation", {"model.move_quats": False}, 27.31),
    _from_paper("representation", "no-mu", "without mu(t): a straight line", {"model.move_means": False}, 27.24),
    _from_paper(
        "training", "random", "without initialization: random", {"init.from_priors": False}, 25.97,
        "our settings neither clone nor split, so a random start stays as coarse as it began",
    ),
    _from_paper("training", "no-velocity", "without flow and rigid loss", {"loss.flow": 0.0, "loss.rigid": 0.0}, 24.89),
    _from_paper("training", "no-rigid", "without rigid loss", {"loss.rigid": 0.0}, 26.87),
    _orders(1, 1, 3, 3, 27.68),
    _orders(3, 3, 3, 3, 27.96),
    _orders(3, 3, 6, 6, 27.80),
    _orders(6, 6, 1, 1, 27.72),
    _orders(6, 6, 6, 6, 27.80),
    _orders(8, 8, 6, 6, 27.64),
    Claim("ours", PAPER_ORDERS, 0, remark="ours are 4, 0; 1, 0"),
    _ours("flow-mean", "flow model: mean (the paper's)", {"flow_model": "mean"}, 0),
    _ours("flow-affine", "flow model: affine", {"flow_model": "affine"}, 0),
    Claim("ours", NO_GAINS, -1),
    Claim(
        "ours",
        Variant(
            "free-background", "the background may move and fade", {"model.gains": 0, "model.freeze_background": False}
        ),
        -1, NO_GAINS,
        remark="what moves has no brightness in time, so this is compared with the row above; all learn at the rates of objects",
    ),
    _ours("even-gains", "fast waves of brightness learn as fast as slow ones", {"rates.gains_falloff": 0.0}),
    _ours("even-rates", "objects learn as fast as the background", {"rates.moving": 1.0, "rates.moving_decay": 0.05}),
    _ours("even-decay", "the rates of objects fall as those of the background", {"rates.moving_decay": 0.05}),
    _ours("last-step", "the result is the last step, not a mean of many", {"average": 0.0}),
    _ours("lens-rates", "positions learn as fast behind a long lens as behind a short one", {"rates.means_pixels": 0.0}),
    _ours("even-rays", "positions learn along their ray as fast as across it", {"rates.along_ray": 1.0}),
    _ours("flow-0.01", "a third of the paper's weight of the flow loss", {"loss.flow": 0.01}, 0),
    _ours("rigid-0.5", "the paper's weight of the rigid loss", {"loss.rigid": 0.5}),
    _ours("no-revise", "what moves is not revised", {"density.revise": False}),
    _ours("prune-0.01", "Gaussians that are needed least go", {"density.prune_change": 0.01}, 0),
    _ours("one-color", "one brightness inside a Gaussian", {"model.slopes": False}),
    _ours("spheres", "start as spheres, not as discs", {"init.surface_aligned": False}),
    _ours("even-detail", "as many Gaussians where nothing is as where the detail is", {"init.detail": 0.0}),
    _ours(
        "samples-7", "7 samples, precision as printed",
        {"init.samples": 7, "init.sample_gap": 0, "init.precision_factor": 49 / 36},
    ),
    _ours("no-coverage", "dark surfaces need not cover their pixels", {"loss.coverage": 0.0}),
    _ours("no-depth", "without depth loss", {"loss.depth": 0.0}),
    _ours("sh-0", "colors of degree 0", {"model.sh_degree": 0}),
    _ours("sh-2", "colors of degree 2", {"model.sh_degree": 2}, 0),
    _ours("no-fill", "uncovered pixels stay black", {"fill": False}),
    Claim(
        "baselines",
        Variant(
            "4dgs", "4DGS: linear, random, no velocity losses",
            {
                "model.move_means": False, "model.move_quats": False, "init.from_priors": False, "loss.flow": 0.0,
                "loss.rigid": 0.0,
            },
            start="paper",
        ),
        -1, paper=round(16.91 - 22.72, 2), remark="the paper's difference is that on the NVIDIA scenes",
    ),
    Claim("baselines", Variant("static", "one static scene", kind="static"), -1),
    Claim("baselines", Variant("per-frame", "a static scene for every frame", kind="per_frame"), -1),
)  # fmt: skip
"""All rows. ``linear`` is also the baseline with everything else ours. The authors' 4DGS has colors that vary with time."""


def choose_claims(names: Sequence[str]) -> list[Claim]:
    """Return the rows of these names (of a variant, or of a whole table), or all of them.

    Raises:
        InputError: there is no such row.
    """
    known = dict.fromkeys([*TITLES, *(claim.variant.name for claim in CLAIMS)])
    for name in names:
        if name not in known:
            raise InputError(f"There is no row {name!r}: choose from {', '.join(known)}.")
    return [claim for claim in CLAIMS if not names or claim.group in names or claim.variant.name in names]


def list_needed_variants(claims: Sequence[Claim]) -> list[Variant]:
    """Return what has to be trained for some rows: their bases first."""
    variants = [claim.base for claim in claims] + [claim.variant for claim in claims]
    return list({variant.name: variant for variant in variants}.values())
