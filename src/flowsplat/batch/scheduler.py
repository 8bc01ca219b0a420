"""Schedule the work of a batch among the processes that share it: each process takes the next piece of work that is open and that
nobody has."""

from __future__ import annotations

import random
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence

from flowsplat.batch.records import END_STATES, Outcome, Record, Records, after_attempt
from flowsplat.batch.work import Engine, Job
from flowsplat.common.errors import InputError
from flowsplat.common.files import Claims

POLL_SECONDS = 10.0
"""Seconds, at least, between two lists while others have what is left. Chosen by eye."""
LISTING_REST = 20
"""Times as long as listing takes the folders are left alone, so that many who wait do no harm. Chosen by eye."""
LIST_SECONDS = 300.0
"""Seconds after which folders are listed anew although jobs are known that were open then: meanwhile others take a few of them,
which is found out one by one. Chosen by eye."""
MAX_MISSES = 8
"""Jobs one after the other that are no longer open after which folders are listed anew, too. Chosen by eye."""
RETRY_SECONDS = 5.0
"""Seconds after which work is tried again that somebody else's run was in the way of."""


class Scheduler:
    """Does the jobs of a batch that are open, with others who do the same. See ``run``."""

    def __init__(
        self, jobs: Sequence[Job], engine: Engine, records: Records, claims: Claims, retry: Collection[str] = (),
        shown: Callable[[Scheduler], None] = lambda _: None, poll: float = POLL_SECONDS,
    ):  # fmt: skip
        """
        Args:
            jobs: all of them, in the order in which they are begun.
            retry: states of records that are tried once more: failed, refused or done.
            shown: called often, to show how far it is.
            poll: seconds, at least, between two lists while others have what is left.
        """
        self._jobs = {job.id: job for job in jobs}
        self._engine, self._records, self._claims, self._shown, self._poll = engine, records, claims, shown, poll
        self.engine, self.total = engine, len(self._jobs)
        self.ended: dict[str, str] = {}
        """The state of every job that has ended, by its id."""
        self.done_here = 0
        """Jobs that ended in this process since it began."""
        self.elsewhere = 0
        """Jobs that others have now, as far as is known."""
        self._before: dict[str, Record | None] = {}
        self._mine: dict[str, int] = {}
        self._dead: dict[str, int] = {}
        self._open: deque[str] = deque()
        self._later: dict[str, float] = {}
        self._listed, self._list_took = -1e9, 0.0
        self._unwritable: str | None = None
        self._first_look(set(retry))

    def run(self) -> dict[str, str]:
        """Work until every job has ended, here or elsewhere.

        Returns:
            the state of each: done, failed or refused.

        Raises:
            InputError: nothing can be written, a full disk, say: what runs ends first, and the same command continues.
        """
        try:
            while not self._is_over():
                self._step()
        except BaseException:
            for each in self._engine.stop():
                self._note(each.job, each.outcome)
            raise
        finally:
            self._claims.close()
        if self._unwritable is not None:
            raise InputError(self._unwritable)
        return dict(self.ended)

    # -- inside

    def _is_over(self) -> bool:
        if self._engine.list_running():
            return False
        return self._unwritable is not None or len(self.ended) == self.total

    def _step(self) -> None:
        while self._unwritable is None and self._engine.has_room() and (name := self._next()) is not None:
            before = self._before[name]
            is_continued = before is not None and before["state"] == "open" and before["key"] == self._jobs[name].key
            self._engine.start(self._jobs[name], is_continued and before is not None and before["fewer"])
        self._shown(self)
        for each in self._engine.wait(0.5 if self._engine.list_running() else min(self._poll, 0.5)):
            self._note(each.job, each.outcome)
        for name in self._claims.list_lost():  # this process slept so long that another one took it
            if name in self._mine:
                self._engine.drop(name)
                self._claims.release(name)
                del self._mine[name]
        self._shown(self)

    def _first_look(self, retry: set[str]) -> None:
        """What was ended by commands before this one: read, because settings or files may have changed since."""
        for name, state in self._records.states().items():
            job = self._jobs.get(name)
            if job is None:
                continue
            record = self._records.read(name)
            if record is not None and state in END_STATES and record["state"] in END_STATES:
                if record["key"] == job.key and record["state"] not in retry:
                    self.ended[name] = record["state"]
                else:
                    self._before[name] = record
        self._again = set(self._before)
        """Ended with other settings, or to be tried once more: open until an attempt beyond that record has ended."""

    def _list(self) -> None:
        """Look which jobs are open: one list of each folder."""
        began = time.monotonic()
        for name, state in self._records.states().items():
            if name in self._jobs and state in END_STATES and name not in self.ended and not self._is_again(name):
                self.ended[name] = state
        self._dead.clear()
        others = set()
        for name, number in self._claims.newest().items():
            if name in self._jobs and name not in self.ended and name not in self._mine:
                if self._claims.is_dead(name, number):
                    self._dead[name] = number
                else:
                    others.add(name)
        self.elsewhere = len(others)
        wanted = [name for name in self._jobs if name not in self.ended and name not in others and name not in self._mine]
        self._open = deque(wanted)
        if others:  # not all begin at the same place
            self._open.rotate(-random.randrange(len(wanted) or 1))
        self._listed = time.monotonic()
        self._list_took = self._listed - began

    def _is_again(self, name: str) -> bool:
        """Return whether a record that has ended is still the one that is to be tried once more."""
        if name not in self._again:
            return False
        record, before = self._records.read(name), self._before.get(name)
        if record is not None and before is not None and record["attempt"] > before["attempt"]:
            self._again.discard(name)
            return False
        return True

    def _next(self) -> str | None:
        """Return the next job, which this process then has; None where there is none for now."""
        if time.monotonic() - self._listed > max(LIST_SECONDS if self._open else self._poll, LISTING_REST * self._list_took):
            self._list()
        skipped: list[str] = []
        found, missed = None, 0
        while self._open and found is None:
            if missed >= MAX_MISSES and time.monotonic() - self._listed > LISTING_REST * self._list_took:
                self._list()
                skipped, missed = [], 0
                continue
            name = self._open.popleft()
            if self._later.get(name, 0.0) > time.monotonic():
                skipped.append(name)
            elif self._take(name):
                found = name
            else:
                missed += 1
        self._open.extend(skipped)
        return found

    def _take(self, name: str) -> bool:
        """Try to get a job."""
        record = self._records.read(name)
        if self._has_ended(name, record):
            return False
        number = max(record["attempt"] if record is not None else 0, self._dead.get(name, 0)) + 1
        try:
            if not self._claims.take(name, number):
                self._open.rotate(-random.randrange(len(self._open) or 1))
                return False
        except InputError as error:
            self._unwritable = str(error)
            return False
        record = self._records.read(name)
        if self._has_ended(name, record) or (record is not None and record["attempt"] >= number):
            self._claims.release(name)
            return False
        self._before[name], self._mine[name] = record, number
        return True

    def _has_ended(self, name: str, record: Record | None) -> bool:
        if record is None or record["state"] not in END_STATES:
            return False
        before = self._before.get(name)
        if name in self._again and before is not None and record["attempt"] <= before["attempt"]:
            return False
        self._again.discard(name)
        self.ended[name] = record["state"]
        return True

    def _note(self, job: Job, outcome: Outcome) -> None:
        """Write down how an attempt ended, if it is still ours, and give it back."""
        name, number = job.id, self._mine.pop(job.id)
        if not self._claims.has(name):
            self._claims.release(name)
            return
        record = after_attempt(self._before[name], name, job.key, number, outcome)
        try:
            if outcome.how != "unwritable":
                self._records.write(record)
        except InputError as error:
            outcome = Outcome("unwritable", str(error))
        if outcome.how == "unwritable":
            self._unwritable = outcome.reason
        elif record["state"] in END_STATES:
            self._again.discard(name)
            self.ended[name] = record["state"]
            self.done_here += 1
        else:
            self._later[name] = time.monotonic() + (RETRY_SECONDS if outcome.how == "busy" else 0.0)
            self._open.append(name)
        self._claims.release(name)

    @property
    def counts(self) -> Counter[str]:
        """How many jobs have ended in each state."""
        return Counter(self.ended.values())
