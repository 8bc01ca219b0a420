"""The tables of the benchmark of movers: by what they are, by how the camera moves, by what is seen of the ground."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from flowsplat.pictures.html import NOTHING
from flowsplat.scenes.synthetic.worlds.parts import KINDS
from flowsplat_benchmarks.movers.measure import AT_FEET, OVERLAP, Record
from flowsplat_benchmarks.movers.preparation import VARIANTS, Variant
from flowsplat_benchmarks.tables import Column, Result, Table, text
from flowsplat_benchmarks.worlds.cameras import CAMERAS
from flowsplat_benchmarks.worlds.plan import GROUNDS

FOUND = (
    Column("signed median", ("signed",), 3, sign=True), Column("course", ("course",), 3), Column("relief", ("relief",), 3),
    Column("IDF1", ("idf1",), 2), Column("mask IoU", ("iou",), 2),
)  # fmt: skip
"""Of the summary of some movers."""

HEADER = (
    "", "movers", "never found", "distance: median", "90th percentile", "within 5 %", *(column.header for column in FOUND),
)  # fmt: skip

STATIC = ("median", "p90")
"""Figures of what rests."""

SIGMAS = (1, 2)
"""Multiples of what is believed of an error whose coverage is told."""

TITLES: dict[Variant, str] = {
    "own": "Cameras, flow and masks from the pictures",
    "true": "True cameras, flow and masks",
}

NOTE = (
    "Distance: |ln(estimated / true depth)|, the median over a mover's pixels and frames; a mover that was never found counts as "
    "infinitely wrong in median, percentile and share. Signed median, course and relief are of those that were found: + is too "
    "far; course is the spread over frames of each frame's median error, relief the spread within a frame (both medians over "
    "movers; spread: half the central 68 %). IDF1 and IoU are means over movers."
)

DEFINITIONS = (
    "With own priors, and where a camera that stands still leaves static depth a guess, depth is brought to the truth's scale by "
    "the median ratio over static pixels with trusted depth, one number a clip.",
    f"A mover was found where, in any frame, its true mask and that of one object overlap by an IoU of {OVERLAP} or more; the same "
    "IoU counts as agreement in a frame for IDF1. Errors are measured at the pixels that are in both masks, whatever the number.",
    "Seeds below 900 are for tuning, 900 to 999 decide between versions and are never looked at one by one, 1000 to 1199 are only "
    "reported.",
)


def is_anchored(mover: Record) -> bool:
    """Whether something ties a mover to the world: it touches the ground, swings, rolls or rests at any time."""
    return bool(mover["contact"] or mover["swings"] or mover["rolls"] or mover["rests"])


def tables(results: Sequence[Result]) -> list[Table]:
    """One table for own priors, one for true ones, and one of what rests."""
    return [*(_table(results, variant) for variant in VARIANTS), _static(results)]


def _static(results: Sequence[Result]) -> Table:
    rows = []
    for variant in VARIANTS:
        for name, parallax in (("depth from the camera's motion", True), ("depth guessed", False)):
            of_them = [r[variant] for r in results if "static" in r[variant] and r[variant]["parallax"] == parallax]
            if of_them:
                figures = [_median(r[part][figure] for r in of_them if r[part]) for part in ("static", "feet") for figure in STATIC]
                rows.append((f"{TITLES[variant]}: {name}", str(len(of_them)), *(text(x, 3) for x in figures)))
    header = ("", "worlds", "median", "90th percentile", "at feet: median", "90th percentile")
    note = (
        f"|ln(estimated / true depth)| over all pixels that rest by the true and by our masks, and over those within {AT_FEET} "
        "pixels of the lowest pixels of movers that touch the ground. Each figure is the median over the worlds."
    )
    return Table("What rests", note, header, rows)


def _table(results: Sequence[Result], variant: Variant) -> Table:
    groups = {name: group for name, group in _groups(results, variant).items() if group}
    rows: list[tuple[str, ...]] = [(name, *_cells(group)) for name, group in groups.items()]
    header: tuple[str, ...] = HEADER
    if any("sigma" in mover for group in groups.values() for mover in group):
        header += tuple(f"within {n} sigma" for n in SIGMAS)
        rows = [(*row, *_coverage(group)) for row, group in zip(rows, groups.values(), strict=True)]
    whole = float(np.mean([result[variant]["idf1"] for result in results])) if results else None
    note = f"{NOTE} IDF1 of a world, objects that are no mover counted as errors: {text(whole, 2)} (mean)."
    return Table(TITLES[variant], note, header, rows, (0, 1))


def _groups(results: Sequence[Result], variant: Variant) -> dict[str, list[Record]]:
    """The movers of every row by its name; a mover is in several."""
    movers = [(mover, result["camera"], result["ground"]) for result in results for mover in result[variant]["movers"]]
    return {
        "all": [mover for mover, _, _ in movers],
        "touch, swing, roll or rest at any time": [mover for mover, _, _ in movers if is_anchored(mover)],
        "nothing ties them": [mover for mover, _, _ in movers if not is_anchored(mover)],
        **{f"kind: {kind}": [mover for mover, _, _ in movers if mover["kind"] == kind] for kind in KINDS},
        "touch another mover": [mover for mover, _, _ in movers if mover["touches"] is not None],
        **{f"camera: {name}": [mover for mover, camera, _ in movers if camera == name] for name in CAMERAS},
        **{f"ground: {name}": [mover for mover, _, ground in movers if ground == name] for name in GROUNDS},
    }


def summary(movers: Sequence[Record]) -> dict[str, float | None]:
    """The figures of a row; None where there are none, infinite where too many were never found."""
    found = [mover for mover in movers if mover["ln_distance"] is not None]
    errors = np.sort([np.inf if mover["ln_distance"] is None else abs(mover["ln_distance"]) for mover in movers])
    # The smallest error that at least such a share does not exceed: nothing is interpolated to infinity.
    median, high = (float(errors[max(int(np.ceil(share * len(errors))) - 1, 0)]) for share in (0.5, 0.9))
    return {
        "lost": float(len(movers) - len(found)), "median": median, "high": high, "within": float((errors <= 0.05).mean()),
        "signed": _median(mover["ln_distance"] for mover in found), "course": _median(mover["course"] for mover in found),
        "relief": _median(mover["relief"] for mover in found), "idf1": float(np.mean([mover["idf1"] for mover in movers])),
        "iou": float(np.mean([mover["iou"] for mover in movers])),
    }  # fmt: skip


def _cells(movers: Sequence[Record]) -> tuple[str, ...]:
    row = summary(movers)
    share = row["within"]
    assert share is not None
    return (
        str(len(movers)), text(row["lost"], 0), _error(row["median"]), _error(row["high"]), f"{100 * share:.0f} %",
        *(column.cell(row) for column in FOUND),
    )  # fmt: skip


def _error(value: float | None) -> str:
    return "not found" if value == np.inf else text(value, 3)


def _coverage(movers: Sequence[Record]) -> tuple[str, ...]:
    """Shares of the movers with a believed error whose true one is within some multiples of it."""
    known = [mover for mover in movers if mover.get("sigma") and mover["ln_distance"] is not None]
    told = [abs(mover["ln_distance"]) / mover["sigma"] for mover in known]
    return tuple(f"{100 * float(np.mean(np.array(told) <= n)):.0f} %" if told else NOTHING for n in SIGMAS)


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
