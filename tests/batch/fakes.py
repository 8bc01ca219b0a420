"""Work that only sleeps, done by threads of this process: what the scheduler and the claims are tried with."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from flowsplat.batch.records import Outcome
from flowsplat.batch.work import Ended, Job, Running, outcome_of

Act = Callable[[Job, bool], Outcome]


class Sleepers:
    """An engine whose work ends when its time has come."""

    def __init__(self, workers: int, act: Act, seconds: float = 0.0):
        """``act`` says how work ends that has slept for ``seconds``."""
        self.workers, self._act, self._seconds = workers, act, seconds
        self.lanes: dict[str, tuple[Job, bool, float]] = {}
        self.started: list[str] = []
        self.dropped: list[str] = []

    def has_room(self) -> bool:
        return len(self.lanes) < self.workers

    def start(self, job: Job, fewer: bool) -> None:
        assert job.id not in self.lanes
        self.started.append(job.id)
        self.lanes[job.id] = (job, fewer, time.monotonic() + self._seconds)

    def wait(self, seconds: float) -> Sequence[Ended]:
        ends = time.monotonic() + seconds
        while True:
            over = [name for name, (_, _, until) in self.lanes.items() if until <= time.monotonic()]
            if over or time.monotonic() >= ends:
                found = [self.lanes.pop(name) for name in over]
                return [Ended(job, self._act(job, fewer)) for job, fewer, _ in found]
            time.sleep(min(0.01, seconds))

    def list_running(self) -> Sequence[Running]:
        return [Running(name, "sleeping", 0.0, None) for name in self.lanes]

    def drop(self, name: str) -> None:
        self.dropped.append(name)
        del self.lanes[name]

    def stop(self) -> Sequence[Ended]:
        found = [Ended(job, Outcome("stopped", "")) for job, _, _ in self.lanes.values()]
        self.lanes.clear()
        return found


def jobs(count: int, key: str = "k") -> list[Job]:
    return [Job(f"clip-{k}", key, dict) for k in range(count)]


class Inline:
    """An engine that does work in this process, one piece at a time, when it is waited for."""

    fewer = False

    def __init__(self) -> None:
        self._jobs: list[Job] = []

    def has_room(self) -> bool:
        return not self._jobs

    def start(self, job: Job, fewer: bool) -> None:
        self._jobs.append(job)

    def wait(self, seconds: float) -> Sequence[Ended]:
        return [Ended(job, outcome_of(job.call, self)) for job in (self._jobs.pop(),)] if self._jobs else []

    def list_running(self) -> Sequence[Running]:
        return [Running(job.id, "at work", 0.0, None) for job in self._jobs]

    def drop(self, name: str) -> None:
        self._jobs.clear()

    def stop(self) -> Sequence[Ended]:
        self._jobs.clear()
        return []

    def needs(self, gib: float) -> None:
        """Of the attempt: there is enough."""
