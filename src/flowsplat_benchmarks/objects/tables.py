"""The tables of the benchmark of objects: by what they are, by how the camera moves, by what is seen of the ground."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from flowsplat.images.html import NOTHING
from flowsplat.scenes.synthetic.worlds.parts import KINDS
from flowsplat_benchmarks.objects.measure import FEET_REACH, MIN_OVERLAP, Record
from flowsplat_benchmarks.objects.preparation import VARIANTS, Variant
from flowsplat_benchmarks.tables import Column, Result, Table, text
from flowsplat_benchmarks.worlds.cameras import CAMERAS
from flowsplat_benchmarks.worlds.plan import GROUNDS

FOUND = (
    Column("signed median", ("signed",), 3, sign=True), Column("depth_trajectory", ("depth_trajectory",), 3),
    Column("shape_offset", ("shape_offset",), 3),
    Column("IDF1", ("idf1",), 2), Column("mask IoU", ("iou",), 2),
)  # fmt: skip
"""Of the summary of some objects."""

HEADER = (
    "", "objects", "never found", "distance: median", "90th percentile", "within 5 %", *(column.header for column in FOUND),
)  # fmt: skip

STATIC = ("median", "p90")
"""Figures of what rests."""

COVERAGE_SIGMAS = (1, 2)
"""Multiples of what is believed of an error whose coverage is told."""

TITLES: dict[Variant, str] = {
    "own": "Cameras, flow and masks from the images",
    "true": "True cameras, flow and masks",
}

NOTE = (
    "Distance: |ln(estimated / true depth)|, the median over an object's pixels and frames; an object that was never found counts "
    "as "
    "infinitely wrong in median, percentile and share. Signed median, depth trajectory and shape offset are of those that were "
    "found: + is too "
    "far; depth trajectory is the spread over frames of each frame's median error, shape offset the spread within a frame (both "
    "medians over "
    "objects; spread: half the central 68 %). IDF1 and IoU are means over objects."
)

DEFINITIONS = (
    "With own priors, and where a camera that stands still leaves static depth a guess, depth is brought to the truth's scale by "
    "the median ratio over static pixels with trusted depth, one number a clip.",
    f"An object was found where, in any frame, its true mask and that of one object overlap by an IoU of {MIN_OVERLAP} or more; "
    "the same IoU counts as agreement in a frame for IDF1. Errors are measured at the pixels that are in both "
    "masks, whatever the number.",
    "Seeds below 900 are for tuning, 900 to 999 decide between versions and are never looked at one by one, 1000 to 1199 are only "
    "reported.",
)


def is_anchored(obj: Record) -> bool:
    """Return whether something ties an object to the world: it touches the ground, swings, rolls or rests at any time."""
    return bool(obj["contact"] or obj["swings"] or obj["rolls"] or obj["rests"])


def tables(results: Sequence[Result]) -> list[Table]:
    """Return one table for own priors, one for true ones, and one of what rests."""
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
        f"|ln(estimated / true depth)| over all pixels that rest by the true and by our masks, and over those within {FEET_REACH} "
        "pixels of the lowest pixels of objects that touch the ground. Each figure is the median over the worlds."
    )
    return Table("What rests", note, header, rows)


def _table(results: Sequence[Result], variant: Variant) -> Table:
    groups = {name: group for name, group in _groups(results, variant).items() if group}
    rows: list[tuple[str, ...]] = [(name, *_cells(group)) for name, group in groups.items()]
    header: tuple[str, ...] = HEADER
    if any("sigma" in obj for group in groups.values() for obj in group):
        header += tuple(f"within {n} sigma" for n in COVERAGE_SIGMAS)
        rows = [(*row, *_coverage(group)) for row, group in zip(rows, groups.values(), strict=True)]
    whole = float(np.mean([result[variant]["idf1"] for result in results])) if results else None
    note = f"{NOTE} IDF1 of a world, objects that are no object counted as errors: {text(whole, 2)} (mean)."
    return Table(TITLES[variant], note, header, rows, (0, 1))


def _groups(results: Sequence[Result], variant: Variant) -> dict[str, list[Record]]:
    """Return the objects of every row by its name; an object is in several."""
    objects = [(obj, result["camera"], result["ground"]) for result in results for obj in result[variant]["objects"]]
    return {
        "all": [obj for obj, _, _ in objects],
        "touch, swing, roll or rest at any time": [obj for obj, _, _ in objects if is_anchored(obj)],
        "nothing ties them": [obj for obj, _, _ in objects if not is_anchored(obj)],
        **{f"kind: {kind}": [obj for obj, _, _ in objects if obj["kind"] == kind] for kind in KINDS},
        "touch another object": [obj for obj, _, _ in objects if obj["touches"] is not None],
        **{f"camera: {name}": [obj for obj, camera, _ in objects if camera == name] for name in CAMERAS},
        **{f"ground: {name}": [obj for obj, _, ground in objects if ground == name] for name in GROUNDS},
    }


def summary(objects: Sequence[Record]) -> dict[str, float | None]:
    """Return the figures of a row; None where there are none, infinite where too many were never found."""
    found = [obj for obj in objects if obj["ln_distance"] is not None]
    errors = np.sort([np.inf if obj["ln_distance"] is None else abs(obj["ln_distance"]) for obj in objects])
    # The smallest error that at least such a share does not exceed: nothing is interpolated to infinity.
    median, high = (float(errors[max(int(np.ceil(share * len(errors))) - 1, 0)]) for share in (0.5, 0.9))
    return {
        "lost": float(len(objects) - len(found)), "median": median, "high": high, "within": float((errors <= 0.05).mean()),
        "signed": _median(obj["ln_distance"] for obj in found),
        "depth_trajectory": _median(obj["depth_trajectory"] for obj in found),
        "shape_offset": _median(obj["shape_offset"] for obj in found), "idf1": float(np.mean([obj["idf1"] for obj in objects])),
        "iou": float(np.mean([obj["iou"] for obj in objects])),
    }  # fmt: skip


def _cells(objects: Sequence[Record]) -> tuple[str, ...]:
    row = summary(objects)
    share = row["within"]
    assert share is not None
    return (
        str(len(objects)), text(row["lost"], 0), _error(row["median"]), _error(row["high"]), f"{100 * share:.0f} %",
        *(column.cell(row) for column in FOUND),
    )  # fmt: skip


def _error(value: float | None) -> str:
    return "not found" if value == np.inf else text(value, 3)


def _coverage(objects: Sequence[Record]) -> tuple[str, ...]:
    """Return shares of the objects with a believed error whose true one is within some multiples of it."""
    known = [obj for obj in objects if obj.get("sigma") and obj["ln_distance"] is not None]
    told = [abs(obj["ln_distance"]) / obj["sigma"] for obj in known]
    return tuple(f"{100 * float(np.mean(np.array(told) <= n)):.0f} %" if told else NOTHING for n in COVERAGE_SIGMAS)


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
