"""Show the progress of a batch: a table that moves on a terminal, a line a minute elsewhere."""

from __future__ import annotations

import time
from types import TracebackType

from rich.live import Live
from rich.table import Table

from flowsplat.batch.scheduler import Scheduler
from flowsplat.common.durations import format_duration
from flowsplat.common.progress import console, is_live, report

LINE_SECONDS = 60.0
"""Seconds between two lines. Chosen by eye."""
MAX_ROWS = 32
"""Running clips that the table lists, at most. Chosen by eye."""


class Progress:
    """Shows a scheduler. A context manager; ``show`` may be called as often as one likes."""

    def __init__(self, noun: str = "clips") -> None:
        """``noun`` says what is worked on."""
        self._noun = noun
        self._began = self._said = time.monotonic()
        self._first: int | None = None
        self._live = Live(console=console, refresh_per_second=2, transient=True) if is_live() else None

    def __enter__(self) -> Progress:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, scheduler: Scheduler) -> None:
        """Draw, or say a line where it is time for one."""
        if self._first is None:
            self._first = len(scheduler.ended)
        if self._live is not None:
            self._live.update(self._table(scheduler))
        elif time.monotonic() - self._said >= LINE_SECONDS:
            self._said = time.monotonic()
            report(self.line(scheduler))

    def line(self, scheduler: Scheduler) -> str:
        """Return how far it is, in words."""
        spent, ended = time.monotonic() - self._began, len(scheduler.ended) - (self._first or 0)
        wrong = [f"{count} {state}" for state, count in sorted(scheduler.counts.items()) if state != "done"]
        counted = f" ({', '.join(wrong)})" if wrong else ""
        parts = [f"{len(scheduler.ended)} of {scheduler.total} {self._noun} have ended{counted}"]
        parts.append(f"{len(scheduler.engine.list_running())} run here")
        if scheduler.elsewhere:
            parts.append(f"{scheduler.elsewhere} elsewhere")
        if ended > 0:
            left = (scheduler.total - len(scheduler.ended)) * spent / ended
            parts += [f"{3600 * ended / spent:.3g} an hour", f"{format_duration(left)} left"]
        return ", ".join(parts) + "."

    def _table(self, scheduler: Scheduler) -> Table:
        table = Table(box=None, pad_edge=False, title=self.line(scheduler), title_justify="left")
        for name in (self._noun, "for", "GiB", ""):
            table.add_column(name, justify="right" if name in ("for", "GiB") else "left", no_wrap=True)
        for each in list(scheduler.engine.list_running())[:MAX_ROWS]:
            held = "" if each.gib is None else f"{each.gib:.1f}"
            table.add_row(each.id, format_duration(each.seconds), held, each.doing)
        return table
