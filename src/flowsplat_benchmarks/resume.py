"""Many measurements, each in a process of its own, by the engines of ``flowsplat batch``; called again, it continues."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from flowsplat.batch.clips import of_shard
from flowsplat.batch.engines import engine_of
from flowsplat.batch.options import EngineOptions
from flowsplat.batch.records import ENDED, Records
from flowsplat.batch.scheduler import Scheduler
from flowsplat.batch.table import Progress
from flowsplat.batch.work import Attempt
from flowsplat.batch.work import Job as Work
from flowsplat.common.errors import InputError
from flowsplat.common.files import Claims, make_folder, read_json, write_json
from flowsplat.common.processes import usable_cores
from flowsplat.common.progress import report


@dataclass(frozen=True)
class BenchmarkOptions(EngineOptions):
    """How a benchmark is done: what does it, and which part of it."""

    workers: int | None = None
    """How many at a time, each in a process with its share of the cores; the default is one, by all cores (two of ``objects``). Two
    by one thread each get more done, but their seconds say less."""


@dataclass(frozen=True)
class Job:
    """One measurement.

    Attributes:
        name: of its file.
        key: a short name of everything that its figures depend on.
        measure: gives them; may raise an InputError. It is sent to another process.
        path: of its file; None = ``OUT/<name>.json``.
    """

    name: str
    key: str
    measure: Callable[[], dict[str, Any]]
    path: Path | None = None

    def file(self, out: Path) -> Path:
        """Where its figures are."""
        return self.path or out / f"{self.name}.json"

    def is_measured(self, out: Path) -> bool:
        """Whether its figures are there."""
        path = self.file(out)
        return path.exists() and read_json(path).get("key", "") == self.key


def measure_jobs(
    jobs: Sequence[Job],
    out: Path,
    write_page: Callable[[Mapping[str, str]], Path],
    noun: str = "scenes",
    again: bool = False,
    options: EngineOptions | None = None,
    workers: int = 1,
    device: str = "cpu",
) -> Path:
    """Measure what is not measured yet with its key, each into its file; one that fails is told and left out.

    Any number of processes may be called on one OUT at the same time; none is at work on what another one measures.

    Args:
        write_page: called after every job with the failed ones and why, writes the page and returns its path.
        noun: what the jobs are, for messages.
        again: measure also what is measured already.
        options: see ``BenchmarkOptions``.
        workers: at a time on this machine where the options do not say it.
        device: on which they compute.

    Returns:
        path of the page.

    Raises:
        InputError: an option cannot be used, the folder cannot be written, or, at the end, which jobs failed.
    """
    options = options or BenchmarkOptions()
    mine = of_shard([job.name for job in jobs], options.shard, os.environ)
    chosen = [job for job in jobs if job.name in mine]
    to_do = [job for job in chosen if again or not job.is_measured(make_folder(out))]
    if len(to_do) < len(chosen):
        report(f"{len(chosen) - len(to_do)} of {len(chosen)} {noun} were measured already.")
    failed = _work(to_do, out, write_page, noun, again, options, workers, device) if to_do else {}
    page = write_page(failed)
    report(f"Look at {page}")
    if failed:
        first = next(iter(failed))
        raise InputError(f"{len(failed)} of {len(chosen)} {noun} could not be run, first {first}: {failed[first]}")
    return page


def _work(
    jobs: Sequence[Job], out: Path, write_page: Callable[[Mapping[str, str]], Path], noun: str, again: bool, options: EngineOptions,
    workers: int, device: str,
) -> dict[str, str]:  # fmt: skip
    """Do them; the names of those that failed, and why."""
    records, wanted = Records(out), getattr(options, "workers", None)
    if options.engine == "embedded":
        wanted = wanted or workers
    threads = max(1, usable_cores() // (wanted or 1))
    engine = engine_of(options, records.folder / "logs", device, wanted, threads=threads)
    work = [Work(job.name, job.key, partial(_measure, job, out.absolute(), again)) for job in jobs]
    failed: dict[str, str] = {}
    told: set[str] = set()
    with Progress(noun) as progress:

        def shown(scheduler: Scheduler) -> None:
            progress.show(scheduler)
            for name in [name for name in scheduler.ended if name not in told]:
                told.add(name)
                if scheduler.ended[name] != "done":
                    record = records.read(name)
                    failed[name] = record["reason"] if record else "its record is gone"
                    report(f"{name} could not be run: {failed[name]}")
                write_page(failed)

        Scheduler(work, engine, records, Claims(records.folder / "claims"), ENDED, shown).run()
    return failed


def _measure(job: Job, out: Path, again: bool, attempt: Attempt) -> Mapping[str, Any]:
    """Measure a job, unless somebody has since it was asked for."""
    if again or not job.is_measured(out):
        report(f"{job.name} ...")
        write_json(job.file(out), {**job.measure(), "key": job.key})
    return {}


def results_at(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """The figures in those of the files that are there, in order."""
    return [read_json(path) for path in paths if path.exists()]


def results_in(protocol: str, out: Path) -> list[dict[str, Any]]:
    """The figures of a protocol that are in a folder, by name."""
    found: list[Any] = [*results_at(sorted(out.glob("[!.]*.json")))]
    return [value for value in found if isinstance(value, dict) and value.get("protocol") == protocol]
