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
from flowsplat_benchmarks.results.rows import FAILED, MEASURED_AT, NOT_MEASURED, Records, Row, one_line
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
            rows.append((name, *_describe(measured, variant, bool(failed)), at))
    for record in records.of("objects"):
        for variant in VARIANTS:
            figures = (record.result or {}).get(SUMMED, {}).get(variant)
            if figures is not None:
                row = Row([record], records.used)
                row.note_commit(record.commit)
                rows.append((f"{record.scene}: {PRIORS[variant]}", *_format(figures, record), record.commit))
    return Table("Random worlds", "40 frames of 320x180. Objects that touch nothing count, too.", HEADER, rows)


def _describe(measured: Sequence[Record], variant: str, has_failed: bool) -> tuple[str, ...]:
    objects = [each for record in measured for each in _objects_of(record, variant)]
    if not objects:
        return (FAILED if has_failed else NOT_MEASURED, *["–"] * (len(HEADER) - 3))
    told = [abs(each["ln_distance"]) / each["sigma"] for each in objects if each.get("sigma") and each["ln_distance"] is not None]
    shares = [100 * float(np.mean(np.array(told) <= n)) for n in COVERAGE_SIGMAS] if told else None
    return _format({**summary(objects), "objects": len(objects), "shares": shares}, measured[0])


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
