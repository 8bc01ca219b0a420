"""Many measurements one after the other; called again, it continues."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_json
from flowsplat.common.progress import say


@dataclass(frozen=True)
class Job:
    """One measurement.

    Attributes:
        name: of its file.
        key: a short name of everything that its figures depend on.
        measure: gives them; may raise an InputError.
    """

    name: str
    key: str
    measure: Callable[[], dict[str, Any]]


def measure_jobs(
    jobs: Sequence[Job],
    out: Path,
    report: Callable[[Mapping[str, str]], Path],
    noun: str = "scenes",
    again: bool = False,
    at_once: int = 1,
) -> Path:
    """Measure what is not measured yet with its key, each into ``OUT/<name>.json``; one that fails is told and left out.

    Args:
        report: called after every job with the failed ones and why, writes the page and returns its path.
        noun: what the jobs are, for messages.
        again: measure also what is measured already.
        at_once: how many are measured at a time, each in a thread that its ``measure`` waits in.

    Returns:
        path of the page.

    Raises:
        InputError: the folder cannot be written, or, at the end, which jobs failed.
    """
    make_folder(out)
    failed: dict[str, str] = {}
    page = out
    waiting, running = deque(enumerate(jobs)), dict[Future[str | None], Job]()
    with ThreadPoolExecutor(at_once) as lanes:
        while waiting or running:
            while waiting and len(running) < at_once:
                k, job = waiting.popleft()
                running[lanes.submit(_measured, job, out, f"{k + 1} of {len(jobs)}", again)] = job
            for done in wait(running, return_when=FIRST_COMPLETED).done:
                job, error = running.pop(done), done.result()
                if error is not None:
                    failed[job.name] = error
            page = report(failed)
    say(f"Look at {page}")
    if failed:
        first = next(iter(failed))
        raise InputError(f"{len(failed)} of {len(jobs)} {noun} could not be run, first {first}: {failed[first]}")
    return page


def _measured(job: Job, out: Path, which: str, again: bool) -> str | None:
    """Measure a job where that is wanted; why it cannot be measured, or None."""
    path = out / f"{job.name}.json"
    if not again and path.exists() and read_json(path).get("key") == job.key:
        say(f"{job.name}: measured already ({which}).")
        return None
    say(f"{job.name} ({which}) ...")
    try:
        write_json(path, {**job.measure(), "key": job.key})
    except InputError as error:
        say(f"{job.name} could not be run: {error}")
        return str(error)
    return None


def results_in(protocol: str, out: Path) -> list[dict[str, Any]]:
    """The figures of a protocol that are in a folder, by name."""
    found = [read_json(path) for path in sorted(out.glob("[!.]*.json"))]
    return [value for value in found if isinstance(value, dict) and value.get("protocol") == protocol]
