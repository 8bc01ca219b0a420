"""An engine of a Ray cluster (https://docs.ray.io): one task a piece of work, with the cores and the memory that it needs.

Ray decides where and when; what is tried again, and that no two are at work on one thing, stays with the scheduler, so that a batch
may be continued with another engine. The clips, OUT and flowsplat must be where the workers are, under the same paths.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flowsplat.batch.embedded import OUTGROWN_FACTOR, STOP_SECONDS, report_into
from flowsplat.batch.records import Outcome
from flowsplat.batch.work import Ended, Job, Running, outcome_of
from flowsplat.common.errors import InputError, describe_install, first_line
from flowsplat.common.processes import THREAD_VARIABLES, usable_cores

TASKS_PER_CORE = 1.25
"""Tasks at a time, in cores of the cluster: some wait, so that a cluster that grows by itself sees that it should. Chosen by eye.
"""
OBJECT_STORE_BYTES = 80 * 2**20
"""Bytes of shared memory of a Ray that is started here: results are small. Chosen by eye."""


@dataclass
class _Task:
    job: Job
    fewer: bool
    ref: Any
    gib: float | None = None
    """What it was given; None while it is asked how much it needs."""
    began: float = field(default_factory=time.monotonic)


class OnRay:
    """See the module."""

    def __init__(self, logs: Path, workers: int | None = None, address: str | None = None, gpus: int = 0):
        """
        Args:
            logs: folder for what each says, ``ID.log``, where the workers see it.
            workers: tasks at a time; None = by the cores of the cluster.
            address: of a cluster to join, as ``ray.init`` takes it; None = one that is started here.
            gpus: of each task.

        Raises:
            InputError: Ray is not installed, or there is no cluster at that address.
        """
        if workers is not None and workers < 1:
            raise InputError("--workers is a number of tasks, 1 or more.")
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            import ray
        except ImportError as error:
            raise InputError(f"--engine ray needs Ray: {describe_install('ray')}.") from error
        self._ray: Any = ray
        if not ray.is_initialized():
            local = {"num_cpus": workers or usable_cores(), "object_store_memory": OBJECT_STORE_BYTES, "include_dashboard": False}
            try:
                ray.init(address=address, log_to_driver=False, **({} if address else local))
            except Exception as error:
                raise InputError(f"No Ray cluster can be joined at {address or 'this machine'}: {first_line(error)}.") from error
        self._logs, self._workers, self._gpus = logs, workers, gpus
        self._tasks: dict[str, _Task] = {}
        self._counted, self._cores = -1e9, 1.0

    def has_room(self) -> bool:
        """As ``Engine``."""
        if self._workers is not None:
            return len(self._tasks) < self._workers
        if time.monotonic() - self._counted > 10:
            self._counted = time.monotonic()
            self._cores = max(1.0, float(self._ray.cluster_resources().get("CPU", 1.0)))
        return len(self._tasks) < TASKS_PER_CORE * self._cores

    def start(self, job: Job, fewer: bool) -> None:
        """As ``Engine``. A first task only asks how much memory the work needs: what is wrong with its input is known then, too."""
        self._tasks[job.id] = _Task(job, fewer, self._submit(job, fewer, None))

    def wait(self, seconds: float) -> list[Ended]:
        """As ``Engine``."""
        if not self._tasks:
            time.sleep(seconds)
            return []
        refs = {task.ref: task for task in self._tasks.values()}
        ready, _ = self._ray.wait(list(refs), num_returns=1, timeout=seconds)
        found = (self._heard(refs[ref]) for ref in ready)
        return [each for each in found if each is not None]

    def list_running(self) -> list[Running]:
        """As ``Engine``."""
        now = time.monotonic()
        doing = {True: "is asked what it needs", False: "is with Ray"}
        return [Running(name, doing[task.gib is None], now - task.began, None) for name, task in self._tasks.items()]

    def drop(self, name: str) -> None:
        """As ``Engine``."""
        task = self._tasks.pop(name)
        with contextlib.suppress(Exception):
            self._ray.cancel(task.ref, force=True)

    def stop(self) -> Sequence[Ended]:
        """As ``Engine``."""
        ended: list[Ended] = []
        try:
            for task in self._tasks.values():
                with contextlib.suppress(Exception):
                    self._ray.cancel(task.ref)
            ends = time.monotonic() + STOP_SECONDS
            while self._tasks and time.monotonic() < ends:
                ended += self.wait(1.0)
        finally:
            for name in list(self._tasks):
                self.drop(name)
        return ended

    # -- inside

    def _submit(self, job: Job, fewer: bool, gib: float | None) -> Any:
        threads = dict.fromkeys(THREAD_VARIABLES, "1")
        options = {"num_cpus": 1, "max_retries": 0, "max_calls": 1, "runtime_env": {"env_vars": threads}, "name": job.id}
        if gib is not None:
            options |= {"memory": int(OUTGROWN_FACTOR * gib * 2**30), "num_gpus": self._gpus}
        return self._ray.remote(**options)(_do).remote(job, fewer, gib, self._logs / f"{job.id}.log")

    def _heard(self, task: _Task) -> Ended | None:
        """Return what a task came to; None where it said what it needs and goes on."""
        errors = self._ray.exceptions
        try:
            found = self._ray.get(task.ref)
        except errors.TaskCancelledError:
            found = Outcome("stopped", "it was asked to stop")
        except errors.OutOfMemoryError as error:
            found = Outcome("outgrew", f"it outgrew the memory of its machine ({first_line(error)})")
        except (errors.NodeDiedError, errors.LocalRayletDiedError, errors.RaySystemError, errors.ObjectLostError) as error:
            found = Outcome("lost", f"its machine was lost ({first_line(error)})")
        except errors.RayError as error:
            found = Outcome("crashed", f"its process ended ({first_line(error)})")
        if not isinstance(found, Outcome):
            task.gib = float(found)
            try:
                task.ref = self._submit(task.job, task.fewer, task.gib)
                return None
            except Exception as error:
                found = Outcome("lost", f"Ray takes nothing more ({first_line(error)})")
        del self._tasks[task.job.id]
        if not found.seconds:
            found = Outcome(found.how, found.reason, found.result, round(time.monotonic() - task.began, 2), found.peak_memory_gib)
        return Ended(task.job, found)


class _Needs(BaseException):
    """Ends work that was only asked how much memory it needs."""

    def __init__(self, gib: float):
        super().__init__()
        self.gib = gib


class _Here:
    """The attempt, where Ray has it done."""

    def __init__(self, fewer: bool, is_asked: bool):
        self.fewer, self._is_asked = fewer, is_asked

    def needs(self, gib: float) -> None:
        """As ``Attempt``."""
        if self._is_asked:
            raise _Needs(gib)


def _do(job: Job, fewer: bool, gib: float | None, log: Path) -> Outcome | float:
    """Return a task: how the work ended, or, where nobody knows yet what it needs, that."""
    report_into(log)
    try:
        return outcome_of(job.call, _Here(fewer, gib is None))
    except _Needs as asked:
        return asked.gib
