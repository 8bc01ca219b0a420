"""The table of random worlds: distances of objects, over many worlds of a kind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat_benchmarks.objects.preparation import VARIANTS
from flowsplat_benchmarks.objects.tables import COVERAGE_SIGMAS, summary
from flowsplat_benchmarks.results.cells import WORLDS
from flowsplat_benchmarks.results.records import Record
from flowsplat_benchmarks.results.rows import FAILED, MEASURED_AT, NOT_MEASURED, Records, Row, add_missing, one_line
from flowsplat_benchmarks.tables import Table, text

LABELS = {"plain": "plain", "crowd": "crowds", "dancers": "dancers"}
PRIORS = {"own": "own priors", "true": "true cameras, flow and masks"}
SUMMED = "summary"
"""Key of figures over many worlds, of which no single ones are kept."""
HEADER = (
    "worlds", "objects", "never found", "distance: median", "90th percentile", "IDF1, mask IoU", "within 1, 2 sigma", MEASURED_AT,
)  # fmt: skip


def tabulate_worlds(records: Records) -> Table:
    """Return a row for each kind of worlds and priors, and for larger sets of which sums were kept.

    Raises:
        InputError: a record is damaged.
    """
    rows: list[tuple[str, ...]] = []
    missing: list[str] = []
    told: list[str] = []
    for kind, seeds in WORLDS.items():
        scenes = [f"{kind}-{seed}" for seed in seeds]
        found = [record for record in records.of("objects") if record.scene in scenes]
        newest = {record.scene: record for record in found}
        row = Row(list(newest.values()), records.used)
        failed = [f"{scene} failed: {each.failure}" for scene, each in newest.items() if each.failure is not None]
        measured = [each for each in newest.values() if each.failure is None]
        for record in measured:
            row.note_commit(record.commit)
        at = "; ".join(one_line(part) for part in ([" and ".join(row.commits)] if row.commits else []) + failed) or "–"
        count = "" if len(measured) == len(scenes) else f", {len(measured)} of {len(scenes)} measured"
        for variant in VARIANTS:
            name = f"{LABELS[kind]}, {seeds.start} to {seeds.stop - 1}{count}: {PRIORS[variant]}"
            if not measured and not failed:
                missing.append(f"{LABELS[kind]}, {seeds.start} to {seeds.stop - 1}: {PRIORS[variant]}")
                continue
            figures = _summarize(measured, variant)
            nothing = (FAILED if failed else NOT_MEASURED, *["–"] * (len(HEADER) - 3))
            rows.append((name, *(nothing if figures is None else _format(figures, measured[0])), at))
            told += [] if figures is None else [_tell(name, figures)]
    for record in records.of("objects"):
        for variant in VARIANTS:
            figures = (record.result or {}).get(SUMMED, {}).get(variant)
            if figures is not None:
                row = Row([record], records.used)
                row.note_commit(record.commit)
                name = f"{record.scene}: {PRIORS[variant]}"
                rows.append((name, *_format(figures, record), record.commit))
                told.append(_tell(name, figures))
    note = " ".join(["40 frames of 320x180. Objects that touch nothing count, too.", *told])
    return Table("Random worlds", add_missing(note, missing, not rows), HEADER, rows)


def _summarize(measured: Sequence[Record], variant: str) -> dict[str, Any] | None:
    """Return the figures over all objects of some worlds; None where there are no objects."""
    objects = [each for record in measured for each in _objects_of(record, variant)]
    if not objects:
        return None
    told = [abs(each["ln_distance"]) / each["sigma"] for each in objects if each.get("sigma") and each["ln_distance"] is not None]
    shares = [100 * float(np.mean(np.array(told) <= n)) for n in COVERAGE_SIGMAS] if told else None
    return {**summary(objects), "objects": len(objects), "shares": shares}


def _tell(name: str, figures: Any) -> str:
    """Return what the figures of a row, which can be formatted, mean for its objects, in a sentence."""
    lost = f"{text(figures['lost'], 0)} of {figures['objects']:,} are never found"
    if figures["median"] is None or figures["median"] == np.inf:
        return f"{name}: at least half of the objects are not found ({lost})."
    far, near = np.expm1(figures["median"]), -np.expm1(-figures["median"])
    return (
        f"{name}: half of the objects are {text(100 * far, 0)} % too far, {text(100 * near, 0)} % too near, or worse, or not "
        f"found; {lost}."
    )


def _format(figures: Any, record: Record) -> tuple[str, ...]:
    try:
        median, high = (
            "not found" if figures[key] is None or figures[key] == np.inf else text(figures[key], 3) for key in ("median", "high")
        )
        shares = "–" if figures["shares"] is None else ", ".join(text(share, 0) for share in figures["shares"]) + " %"
        cells = (f"{figures['objects']:,}", text(figures["lost"], 0), median, high)
        return (*cells, f"{text(figures['idf1'], 2)}, {text(figures['iou'], 2)}", shares)
    except (KeyError, TypeError, ValueError) as error:
        raise _refuse(record) from error


def _objects_of(record: Record, variant: str) -> list[dict[str, Any]]:
    try:
        objects = (record.result or {})[variant]["objects"]
        wanted = ("ln_distance", "depth_trajectory", "shape_offset", "idf1", "iou")
        return [{"sigma": each.get("sigma"), **{key: each[key] for key in wanted}} for each in objects]
    except (KeyError, TypeError, AttributeError) as error:
        raise _refuse(record) from error


def _refuse(record: Record) -> InputError:
    return InputError(f"The record of {record.benchmark} {record.scene} is damaged: it lacks figures of its objects.")
