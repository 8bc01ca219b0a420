"""The tables of the quick oracles as Markdown and as a page: how far off every object is, by what is true of the masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from flowsplat.evaluation.scores import mean_of
from flowsplat.images.html import NOTHING
from flowsplat_benchmarks.oracles.report import MEANINGS
from flowsplat_benchmarks.oracles.scenes import ORACLES
from flowsplat_benchmarks.reports import Report, failures, runs_measured
from flowsplat_benchmarks.tables import Result, Table, describe_version, label, text

TITLE = "Faults of masks, and the distance of objects"
"""Of the page."""
REMARK = (
    "Nothing is trained. From own priors on each of *ids*, *shadow*, *parts* and *masks* holds what is true in those before it; "
    "depth is our own, made anew from these masks."
)
"""Stands above the tables."""


def write_quick_report(out: Path, results: Sequence[Result], failed: Mapping[str, str]) -> Path:
    """Write ``OUT/oracles_quick.md`` and ``.html`` and return the path of the page.

    Args:
        results: the JSON of scenes (``quick.measure_distances`` by oracle).
        failed: scenes that could not be measured, and why.

    Raises:
        InputError: the folder cannot be written.
    """
    remarks = [REMARK, *([describe_version(results)] if results else []), *failures(failed)]
    found = [_distances(results), _scenes(results)] if results else []
    return Report("oracles_quick", TITLE, runs_measured(results, failed), remarks, found).write(out)


def _list_oracles(results: Sequence[Result]) -> list[str]:
    return [oracle for oracle in ORACLES if any(oracle in result["oracles"] for result in results)]


def _distances(results: Sequence[Result]) -> Table:
    """Return ln(estimated / true) of the distance of every object, by oracle."""
    oracles = _list_oracles(results)
    rows = []
    for result in sorted(results, key=lambda result: str(result["scene"])):
        found = result["oracles"]
        for index, obj in enumerate(next(iter(found.values()))["objects"]):
            errors = [found[oracle]["objects"][index]["ln_distance"] if oracle in found else None for oracle in oracles]
            rows.append((label(result), str(index + 1), str(obj["frames"]), *(text(error, 3, sign=True) for error in errors)))
    note = (
        "ln(estimated / true) of the distance of an object: median over the pixels that are in our masks and truly on it, whatever "
        f"their number, and over frames (+.01: one percent too far). {NOTHING}: never found."
    )
    return Table(
        "Distance of objects", note, ("scene", "true object", "frames", *(name.replace("_", " ") for name in oracles)), rows
    )


def _scenes(results: Sequence[Result]) -> Table:
    """Return the summary of every scene, by oracle."""
    rows: list[tuple[str, ...]] = []
    for result in sorted(results, key=lambda result: str(result["scene"])):
        for oracle in _list_oracles([result]):
            found = result["oracles"][oracle]
            errors = [abs(obj["ln_distance"]) for obj in found["objects"] if obj["ln_distance"] is not None]
            overlap = [obj["iou"] for obj in found["objects"]]
            rows.append(
                (
                    label(result), MEANINGS[oracle], f"{len(errors)} of {len(overlap)}", text(found["idf1"], 3),
                    text(mean_of(overlap), 3), text(float(np.median(errors)) if errors else None, 3),
                    text(max(errors, default=None), 3), text(found["static"], 4),
                )
            )  # fmt: skip
    note = "Distance: |ln(estimated / true)| of the objects that were found; what rests: its median over pixels."
    header = ("scene", "true", "found", "IDF1", "mask IoU", "distance: median", "distance: largest", "what rests")
    return Table("Scenes", note, header, rows)
