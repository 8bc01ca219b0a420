"""A simulated cluster: the real scheduler, records and claims of ``flowsplat batch``, with runs that only sleep.

``python -m flowsplat_benchmarks.scripts.cluster OUT --clips 10000 --workers 200``.
Every worker is a process with one lane that takes itself for a machine of its own, so that only heartbeats tell others that it is
dead. It dies (SIGKILL) in the middle of a run at random, and another one is started in its place. In the end: was every clip done,
was any done twice, were ever two at work on one? And what does it cost on the shared folder: calls that touch it, a clip and a
second.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from flowsplat.batch.records import Outcome, Records
from flowsplat.batch.scheduler import Scheduler
from flowsplat.batch.work import Ended, Job, Running
from flowsplat.common.files import Claims
from flowsplat.common.process_control import KILLED_CODES, kill_this_process

MODULE = "flowsplat_benchmarks.scripts.cluster"
"""This one, which its processes run."""
COUNTED = ("open", "os.listdir", "os.scandir", "os.remove", "os.rename", "os.utime", "os.mkdir")
"""Events of Python's audit hooks that are calls to the file system; ``stat`` has none and is counted apart."""


class Nap:
    """An engine with one lane that sleeps, and dies at random. What it does is in a log, with the machine's clock."""

    def __init__(self, seconds: float, deaths: float, log: Path, calls: Counter[str]):
        self._seconds, self._deaths, self._calls = seconds, deaths, calls
        self._log = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self._job: Job | None = None
        self._until = 0.0
        self._dies = False

    def has_room(self) -> bool:
        return self._job is None

    def start(self, job: Job, fewer: bool) -> None:
        self._job, now = job, time.monotonic()
        self._until = now + random.uniform(0.5, 1.5) * self._seconds
        self._dies = random.random() < self._deaths
        if self._dies:
            self._until = now + random.uniform(0, self._until - now)
        self._report("begins", job.id)

    def wait(self, seconds: float) -> Sequence[Ended]:
        if self._job is None:
            time.sleep(seconds)
            return []
        time.sleep(max(0.0, min(seconds, self._until - time.monotonic())))
        if time.monotonic() < self._until:
            return []
        job, self._job = self._job, None
        self._report("dies" if self._dies else "ends", job.id)
        if self._dies:
            kill_this_process()
        return [Ended(job, Outcome("done", result={"verdict": "it slept"}))]

    def list_running(self) -> Sequence[Running]:
        return [] if self._job is None else [Running(self._job.id, "sleeps", 0.0, None)]

    def drop(self, name: str) -> None:
        self._report("drops", name)
        self._job = None

    def stop(self) -> Sequence[Ended]:
        return []

    def _report(self, what: str, name: str) -> None:
        os.write(self._log, f"{json.dumps([time.monotonic(), what, name, sum(self._calls.values())])}\n".encode())


def worker(options: argparse.Namespace) -> None:
    """One worker, until all has ended or it is dead."""
    random.seed(options.number)
    calls: Counter[str] = Counter()
    folder = str(options.out)

    def count(event: str, arguments: tuple[Any, ...]) -> None:
        if event in COUNTED and arguments and str(arguments[0]).startswith(folder):
            calls[event] += 1

    stat = os.stat

    def counted_stat(path: Any, *rest: Any, **named: Any) -> os.stat_result:
        if str(path).startswith(folder):
            calls["stat"] += 1
        return stat(path, *rest, **named)

    sys.addaudithook(count)
    os.stat = counted_stat
    claims = Claims(options.out / "claims", options.beat, options.lost, place=f"machine {options.number}")
    jobs = [Job(f"clip-{k}", "k", lambda _: {}) for k in range(options.clips)]
    engine = Nap(options.seconds, options.deaths, options.out / "logs" / f"{options.number}.log", calls)
    Scheduler(jobs, engine, Records(options.out), claims, poll=options.poll).run()
    (options.out / "logs" / f"{options.number}.json").write_text(json.dumps(calls))


def simulate(
    out: Path, clips: int, workers: int, seconds: float, deaths: float, beat: float, lost: float, poll: float
) -> dict[str, Any]:
    """Run the cluster and return what was seen."""
    (out / "logs").mkdir(parents=True)
    settings = {"clips": clips, "seconds": seconds, "deaths": deaths, "beat": beat, "lost": lost, "poll": poll}
    command = [sys.executable, "-m", MODULE, str(out)]
    for name, value in settings.items():
        command += [f"--{name}", str(value)]
    began, number, died = time.monotonic(), 0, 0
    running: list[subprocess.Popen[bytes]] = []
    while number < workers or running:
        for process in list(running):
            if process.poll() is not None:
                running.remove(process)
                died += process.returncode != 0
                if process.returncode not in (0, *KILLED_CODES):
                    raise SystemExit(f"a worker ended with {process.returncode}")
        while len(running) < workers and number < workers + died:
            running.append(subprocess.Popen([*command, "--number", str(number)]))
            number += 1
        time.sleep(0.05)
    took = time.monotonic() - began
    return {**examine(out, clips), "workers": workers, **settings, "workers that died": died, "took, s": round(took, 1)}


def examine(out: Path, clips: int) -> dict[str, Any]:
    """Return what became of all clips, from the records and from what every worker wrote down."""
    spans: dict[str, list[tuple[float, float]]] = defaultdict(list)
    ends: Counter[str] = Counter()
    calls, slept, first, last = 0, 0.0, float("inf"), 0.0
    gaps: list[float] = []
    for path in (out / "logs").glob("*.log"):
        begun, most = 0.0, 0
        free: float | None = None
        for line in path.read_text().splitlines():
            when, what, name, most = json.loads(line)
            first, last = min(first, when), max(last, when)
            if what == "begins":
                begun = when
                if free is not None:
                    gaps.append(when - free)
                continue
            spans[name].append((begun, when))
            slept += when - begun
            free = when
            ends[name] += what == "ends"
        calls += most
    overlapping = 0
    for each in spans.values():
        each.sort()
        overlapping += sum(second[0] < first[1] for first, second in pairwise(each))
    states = Counter(Records(out).states().values())
    gaps.sort()
    return {
        "done": states["done"], "not done": clips - states["done"], "done twice": sum(count > 1 for count in ends.values()),
        "two at work at a time": overlapping, "attempts": sum(map(len, spans.values())),
        "between two clips of a worker, median s": round(gaps[len(gaps) // 2], 4) if gaps else None,
        "between two clips of a worker, 99 %, s": round(gaps[len(gaps) * 99 // 100], 4) if gaps else None,
        "calls to the folder a clip": round(calls / clips, 1), "calls to the folder a second": round(calls / (last - first), 1),
        "claims left": len(list((out / "claims").iterdir())),
    }  # fmt: skip


def main() -> None:
    """Simulate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--clips", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=4.0, help="of a run, on average")
    parser.add_argument("--deaths", type=float, default=0.03, help="share of the runs in which the worker dies")
    parser.add_argument("--beat", type=float, default=3.0)
    parser.add_argument("--lost", type=float, default=30.0)
    parser.add_argument("--poll", type=float, default=10.0)
    parser.add_argument("--number", type=int, default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.number is not None:
        worker(options)
        return
    shape = (options.seconds, options.deaths, options.beat, options.lost, options.poll)
    print(json.dumps(simulate(options.out, options.clips, options.workers, *shape), indent=1))


if __name__ == "__main__":
    main()
