"""The engine that is built in: one spawned process a piece of work, as many as cores and memory allow."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import Any

from flowsplat.batch.records import Outcome
from flowsplat.batch.work import Ended, Job, Running, outcome_of
from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder
from flowsplat.common.memory import free_memory, keep_imported, memory_of
from flowsplat.common.processes import end_with_parent, threads_of_new_processes, usable_cores
from flowsplat.common.progress import describe_progress
from flowsplat.common.stopping import signals_stop

OUTGROWN_FACTOR = 1.25
"""A process may take so many times what was estimated before it counts as one that outgrew its share. Chosen by eye."""
MEMORY_SHARE = 0.9
"""Of the memory that is free in the beginning. Chosen by eye."""
MEMORY_RESERVE = 0.25
"""GiB: with less free, other programs have taken what there was. Chosen by eye."""
MEMORY_CHECK_SECONDS = 0.5
"""Seconds between two looks at the memory of the processes. Chosen by eye."""
STOP_SECONDS = 60.0
"""Seconds in which a process that was asked to stop may finish a step and write a checkpoint. Chosen by eye."""
REPORT_SECONDS = 1.0
"""Seconds between two words of a process on where it is. Chosen by eye."""


@dataclass
class _Lane:
    """A process and what is known of it."""

    job: Job
    process: Any
    pipe: Connection
    began: float = field(default_factory=time.monotonic)
    wants: float | None = None
    """GiB that it waits for."""
    share: float = 0.0
    """GiB that it was given."""
    holds: float | None = None
    doing: str = "starting"
    outcome: Outcome | None = None
    outgrew: bool = False


class Embedded:
    """See the module. Each process is killed by the system alone, so that no crash of one concerns another."""

    def __init__(self, logs: Path, workers: int | None = None, memory: float | None = None, threads: int = 1):
        """
        Args:
            logs: folder for what each says, ``ID.log``.
            workers: processes at a time; None = one a core, divided by ``threads``.
            memory: GiB for all of them together; None = most of what is free now.
            threads: of each.

        Raises:
            InputError: the folder cannot be made, or a number is none.
        """
        if (workers is not None and workers < 1) or (memory is not None and not memory > 0):
            raise InputError("--workers is a number of processes, 1 or more, and --memory GiB for all of them, more than 0.")
        self._logs, self._threads = make_folder(logs), threads
        self.workers = workers or max(1, usable_cores() // threads)
        free = free_memory()
        self.memory = memory if memory is not None else None if free is None else MEMORY_SHARE * free
        self._lanes: dict[str, _Lane] = {}
        self._looked, self._stopping = 0.0, False

    def has_room(self) -> bool:
        """As ``Engine``: a lane is free, and nobody waits for memory already."""
        return len(self._lanes) < self.workers and all(lane.wants is None for lane in self._lanes.values())

    def start(self, job: Job, fewer: bool) -> None:
        """As ``Engine``.

        Raises:
            InputError: the system starts no process.
        """
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, job, fewer, self._logs / f"{job.id}.log"))
        try:
            with threads_of_new_processes(self._threads):
                process.start()
        except OSError as error:
            raise InputError(f"No process can be started: {error.strerror or error}. The same command continues.") from error
        theirs.close()
        self._lanes[job.id] = _Lane(job, process, ours)

    def wait(self, seconds: float) -> list[Ended]:
        """As ``Engine``; meanwhile it keeps an eye on the memory."""
        ends = time.monotonic() + seconds
        while True:
            self._hear(max(0.0, min(ends - time.monotonic(), MEMORY_CHECK_SECONDS)))
            self._admit()
            if time.monotonic() - self._looked >= MEMORY_CHECK_SECONDS:
                self._looked = time.monotonic()
                self._watch()
            ended = [self._end(lane) for lane in list(self._lanes.values()) if not lane.process.is_alive()]
            if ended or time.monotonic() >= ends:
                return ended

    def list_running(self) -> list[Running]:
        """As ``Engine``."""
        now = time.monotonic()
        return [Running(name, lane.doing, now - lane.began, lane.holds) for name, lane in self._lanes.items()]

    def drop(self, name: str) -> None:
        """As ``Engine``."""
        lane = self._lanes.pop(name)
        lane.process.kill()
        lane.process.join()
        lane.pipe.close()

    def stop(self) -> Sequence[Ended]:
        """As ``Engine``; after ``STOP_SECONDS``, or when interrupted once more, what still lives is killed."""
        ended: list[Ended] = []
        self._stopping = True
        try:
            for lane in self._lanes.values():
                lane.process.terminate()
            ends = time.monotonic() + STOP_SECONDS
            while self._lanes and time.monotonic() < ends:
                ended += self.wait(MEMORY_CHECK_SECONDS)
        finally:
            for name in list(self._lanes):
                self.drop(name)
        return ended

    # -- inside

    def _hear(self, seconds: float) -> None:
        """Take what the processes say, waiting at most so long for a first word."""
        pipes = {lane.pipe: lane for lane in self._lanes.values() if not lane.pipe.closed}
        if not pipes:
            time.sleep(seconds)
            return
        for pipe in wait_for(list(pipes), seconds):
            lane = pipes[pipe]  # type: ignore[index]
            try:
                what, value = lane.pipe.recv()
            except Exception:  # it ended, perhaps in the middle of a word
                lane.pipe.close()
                lane.process.join(STOP_SECONDS)
                continue
            if what == "needs":
                lane.wants, lane.doing = value, "waiting for memory"
            elif what == "doing":
                lane.doing = value
            else:
                lane.outcome = value

    def _admit(self) -> None:
        """Give memory to who waits for it, as far as there is; one alone gets whatever it wants."""
        for lane in self._lanes.values():
            if lane.wants is None:
                continue
            share = OUTGROWN_FACTOR * lane.wants
            given = sum(max(other.share, other.holds or 0.0) for other in self._lanes.values() if other.share)
            if not given or self.memory is None or given + share <= self.memory:
                lane.share, lane.wants, lane.doing = share, None, "starting"
                with contextlib.suppress(OSError):
                    lane.pipe.send(True)

    def _watch(self) -> None:
        """Where memory runs short, end the process that has outgrown its share the most."""
        for lane in self._lanes.values():
            lane.holds = memory_of(lane.process.pid)
        if self.memory is None:
            return
        free = free_memory()
        short = sum(lane.holds or 0.0 for lane in self._lanes.values()) > self.memory or (
            free is not None and free < MEMORY_RESERVE
        )
        grown = [(lane.holds - lane.share, lane) for lane in self._lanes.values() if lane.share and lane.holds is not None]
        most, worst = max(grown, key=lambda each: each[0], default=(0.0, None))
        if short and worst is not None and most > 0 and not worst.outgrew:
            worst.outgrew = True
            worst.process.kill()

    def _end(self, lane: _Lane) -> Ended:
        with contextlib.suppress(Exception):
            while not lane.pipe.closed and lane.pipe.poll():
                what, value = lane.pipe.recv()
                if what == "ended":
                    lane.outcome = value
        lane.pipe.close()
        lane.process.join()
        del self._lanes[lane.job.id]
        if lane.outcome is not None:
            return Ended(lane.job, lane.outcome)
        if self._stopping:  # so early that it could not say it itself
            return Ended(lane.job, Outcome("stopped", "it was asked to stop"))
        seconds, code = round(time.monotonic() - lane.began, 2), lane.process.exitcode
        if lane.outgrew:
            held = f"{lane.holds or 0:.1f} GiB held, {lane.share:.1f} GiB its share, {self.memory:.1f} GiB for all"
            return Ended(lane.job, Outcome("outgrew", f"it outgrew its memory ({held})", None, seconds, lane.holds))
        why = f"exit code {code}"
        if code is not None and code < 0:
            with contextlib.suppress(ValueError):
                why = f"signal {signal.Signals(-code).name}"
        return Ended(lane.job, Outcome("crashed", f"its process was ended by {why}", None, seconds, lane.holds))


class _Here:
    """The attempt, in its own process."""

    def __init__(self, pipe: Connection, fewer: bool):
        self.fewer, self._pipe, self._turn = fewer, pipe, threading.Lock()

    def needs(self, gib: float) -> None:
        """As ``Attempt``."""
        self.tell("needs", gib)
        self._pipe.recv()

    def tell(self, what: str, value: Any) -> None:
        """A word to the other side, which may be gone."""
        with self._turn, contextlib.suppress(OSError):
            self._pipe.send((what, value))


def report_into(log: Path) -> None:
    """From here on what this process says goes behind what ``log`` holds; what native code says, too."""
    with contextlib.suppress(OSError):
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        for number in (1, 2):
            os.dup2(file, number)
        os.close(file)


def _serve(pipe: Connection, job: Job, fewer: bool, log: Path) -> None:
    """A process from its beginning to its end; what it says goes into ``log``."""
    end_with_parent()
    keep_imported()
    report_into(log)
    here, over = _Here(pipe, fewer), threading.Event()

    def tell() -> None:
        said = None
        while not over.wait(REPORT_SECONDS):
            now = describe_progress()
            if now is not None and now != said:
                here.tell("doing", now)
                said = now

    threading.Thread(target=tell, daemon=True).start()
    try:
        with signals_stop():
            outcome = outcome_of(job.call, here)
    except KeyboardInterrupt:
        outcome = Outcome("stopped", "it was asked to stop")
    over.set()
    here.tell("ended", outcome)
    sys.stdout.flush()
    sys.stderr.flush()
