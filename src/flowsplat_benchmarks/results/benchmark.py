"""Do all cells that are not done at this commit, short ones first, and write the results pages; called again, it continues."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from flowsplat.common.durations import format_duration
from flowsplat.common.files import make_folder, write_json
from flowsplat.common.progress import report
from flowsplat.common.source import source_state
from flowsplat_benchmarks.clock import by_the_processor
from flowsplat_benchmarks.results.cells import Cell, choose_cells, list_cells
from flowsplat_benchmarks.results.jobs import list_missing, measure_cell
from flowsplat_benchmarks.results.pages import OVERVIEW, format_pages, write_pages
from flowsplat_benchmarks.results.records import (
    WITH_CHANGES,
    Record,
    describe_commit,
    describe_machine,
    read_record,
    read_records,
    write_record,
)
from flowsplat_benchmarks.results.rows import Records
from flowsplat_benchmarks.resume import BenchmarkOptions, Measurement, measure_jobs

CELLS, WORK, PAGES = "cells", "work", "pages"
"""In OUT: a record of each cell, what they work in (by the state of the source), and the pages."""
MIN_KNOWN_SECONDS = 600.0
"""Estimated seconds of what is done from which on that tells how fast the machine is: of short cells starting is most. Chosen by
eye."""
RECORDS = "records"
"""In the folder of the pages of the documentation: what they are written of."""


def run_all(
    root: Path, out: Path, only: Sequence[str] = (), seeds: Sequence[int] = (), dry_run: bool = False, report_only: bool = False,
    retry_failed: bool = False, docs: Path | None = None, options: BenchmarkOptions | None = None,
) -> Path | None:  # fmt: skip
    """Do or continue cells: ``OUT/cells/<cell>.json`` each, and ``OUT/pages``.

    Args:
        root: the data root. Cells whose scene is not there are told and left out.
        only: benchmarks, scenes or names of cells; none = all.
        seeds: only cells with these; none = all.
        dry_run: only list the cells, with what each takes.
        report_only: only write the pages.
        retry_failed: do those once more that failed at this commit.
        docs: folder of the pages of the documentation: they are written there, too, and the records kept beside them; those of
            this commit that are there already count as done.
        options: how many at a time, and by what.

    Returns:
        path of the first page; None of a dry run.

    Raises:
        InputError: a name cannot be used, a record is damaged, a folder cannot be written, or, at the end, which cells failed.
    """
    chosen = choose_cells(list_cells(), only, seeds)
    missing = list_missing(root, chosen)
    chosen = [cell for cell in chosen if cell not in missing]
    if dry_run:
        print("\n".join(describe_plan(chosen, missing, out, None if docs is None else docs / RECORDS)))
        return None
    if report_only:
        return write_report(out, docs)
    if missing:
        scenes = ", ".join(dict.fromkeys(cell.folder for cell in missing))
        report(f"{len(missing)} cells are left out, whose scenes are not in {root}: {scenes}.")
    if docs is not None:
        _take_kept(chosen, out, docs / RECORDS)
    if retry_failed:
        _forget_failed(chosen, out)
    jobs = [make_measurement(cell, root, out) for cell in chosen]

    def note(failed: Mapping[str, str]) -> Path:
        for cell in chosen:
            if cell.name in failed:
                _keep_failure(cell, failed[cell.name], out)
        return write_report(out, docs)

    return measure_jobs(jobs, out, note, "cells", options=options)


def make_measurement(cell: Cell, root: Path, out: Path) -> Measurement:
    """Return the measurement of a cell; it is done where its record is of this commit."""
    work = partial(_measure, cell, root.absolute(), out.absolute() / WORK / source_state())
    return Measurement(cell.name, _key(), work, out / CELLS / f"{cell.name}.json")


def _key() -> str:
    """Return what the figures of a cell depend on beside its settings."""
    return f"{describe_commit()}, {source_state()}"


def _measure(cell: Cell, root: Path, work: Path) -> dict[str, Any]:
    began = time.perf_counter()
    with by_the_processor() if _counts_processor() else nullcontext():
        result = measure_cell(cell, root, work)
    record = _empty(cell)  # after the measurement: it says when that ended
    machine = record.machine + (", seconds of the processor" if _counts_processor() else "")
    return replace(record, machine=machine, seconds=round(time.perf_counter() - began, 1), result=result).to_json()


def _counts_processor() -> bool:
    """Return whether seconds in a cell's figures are those of the processor: of one thread they are what the clock of an idle
    machine would say, and cells beside each other leave them as they are."""
    return torch.get_num_threads() == 1


def _empty(cell: Cell) -> Record:
    known = cell.benchmark, cell.scene, cell.variant, cell.seed
    return Record(*known, describe_commit(), describe_machine(), torch.get_num_threads(), ended=round(time.time()))


def _keep_failure(cell: Cell, reason: str, out: Path) -> None:
    record = replace(_empty(cell), threads=None, failure=reason)
    write_json(out / CELLS / f"{cell.name}.json", {**record.to_json(), "key": _key()})


def _take_kept(cells: Sequence[Cell], out: Path, kept: Path) -> None:
    """Take into ``out`` what was measured at this commit elsewhere, on another machine say, and is kept with the pages."""
    for cell in cells:
        record = _find_kept(cell, kept)
        if record is not None and not make_measurement(cell, Path(), out).is_measured(make_folder(out)):
            write_json(make_folder(out / CELLS) / f"{cell.name}.json", {**record.to_json(), "key": _key()})


def _find_kept(cell: Cell, kept: Path | None) -> Record | None:
    """Return what is kept of a cell with the pages, where it is of this commit; of source with changes nobody knows which."""
    there = None if kept is None else kept / f"{cell.name}.json"
    if there is None or not there.exists() or describe_commit().endswith(WITH_CHANGES):
        return None
    record = read_record(there)
    return record if record.commit == describe_commit() else None


def _forget_failed(cells: Sequence[Cell], out: Path) -> None:
    for cell in cells:
        path = out / CELLS / f"{cell.name}.json"
        if path.exists() and read_record(path).failure is not None:
            path.unlink()


# -- what is there


def write_report(out: Path, docs: Path | None = None) -> Path:
    """Write the pages of what is in ``out``, and return the path of the first.

    Args:
        docs: as ``run_all``. With it, what was kept there before counts, too, as far as ``out`` has nothing newer of the cell.

    Raises:
        InputError: a record is damaged, or a folder cannot be written.
    """
    found = read_records(out / CELLS)
    if docs is None:
        write_pages(found, out / PAGES, with_links=False)
        return out / PAGES / f"{OVERVIEW}.md"
    format_pages(Records(found))  # before anything damaged is kept
    kept = make_folder(docs / RECORDS)
    for record in found:
        cell = Cell(record.benchmark, record.scene, record.variant, record.seed, 0.0)
        path = kept / f"{cell.name}.json"
        if not path.exists() or record.replaces(read_record(path)):
            write_record(path, record)
    write_pages(read_records(kept), docs)
    return docs / f"{OVERVIEW}.md"


def describe_plan(cells: Sequence[Cell], missing: Sequence[Cell], out: Path, kept: Path | None = None) -> list[str]:
    """Return a line a cell with its state and what it takes, and how long the rest takes in all.

    What is done already says how much faster or slower this machine is than the one of the estimates.

    Raises:
        InputError: a record is damaged.
    """
    done: dict[str, Record] = {}
    for cell in cells:
        path = out / CELLS / f"{cell.name}.json"
        if make_measurement(cell, Path(), out).is_measured(out):
            done[cell.name] = read_record(path)
        elif (record := _find_kept(cell, kept)) is not None:
            done[cell.name] = record
    took = [(done[cell.name].seconds, cell.seconds) for cell in cells if cell.name in done]
    known = [(seconds, each) for seconds, each in took if seconds is not None]
    expected = sum(each for _, each in known)
    factor = sum(seconds for seconds, _ in known) / expected if expected >= MIN_KNOWN_SECONDS else 1.0
    lines = []
    for cell in cells:
        record = done.get(cell.name)
        if record is None:
            lines.append(f"{cell.name}: to do, about {format_duration(factor * cell.seconds)}")
        elif record.failure is not None:
            lines.append(f"{cell.name}: failed: {record.failure}")
        else:
            lines.append(f"{cell.name}: done in {format_duration(record.seconds or 0.0)}")
    lines += [f"{cell.name}: left out, {cell.folder} is not in the data root" for cell in missing]
    left = [cell.seconds for cell in cells if cell.name not in done]
    lines.append(
        f"{len(cells)} cells, {len(done)} done at {describe_commit()}; the rest takes about {format_duration(factor * sum(left))}."
    )
    return lines
