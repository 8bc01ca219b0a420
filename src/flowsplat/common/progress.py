"""Report progress in one way: live bars on a terminal and in a notebook, and a line every half a minute everywhere else."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import threading
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from flowsplat.common.durations import format_duration

Item = TypeVar("Item")

LINES_VARIABLE = "FLOWSPLAT_PROGRESS_SECONDS"
"""The variable of the environment that says how often a line tells how far it is where no bar can move."""


def _read_line_seconds() -> float:
    with contextlib.suppress(KeyError, ValueError):
        if 0.1 <= (seconds := float(os.environ[LINES_VARIABLE])) <= 3600:
            return seconds
    return 30.0


LINE_SECONDS = _read_line_seconds()
"""Seconds between two lines where no bar can move: in pipes, files and CI. Chosen by eye."""

console = Console(stderr=True, highlight=False)


_parts: list[str] = []
"""What goes on as a whole, of whose parts nothing is shown."""
_said: set[str] = set()
"""What ``report_once`` has printed."""


def report(message: str) -> None:
    """Print one line on stderr."""
    if not _parts:
        _print(message)


def _print(message: str) -> None:
    console.print(message, markup=False, soft_wrap=True)


@contextlib.contextmanager
def as_one(label: str) -> Iterator[None]:
    """One bar for all that goes on inside: its own bars and lines are not shown."""
    with spinner(label):
        _parts.append(label)
        try:
            yield
        finally:
            _parts.remove(label)


def report_once(message: str) -> None:
    """Print one line, the first time only that it is to be said."""
    if not _parts and message not in _said:
        _said.add(message)
        report(message)


def forget_reported() -> None:
    """What was said counts as not said."""
    _said.clear()


def is_live() -> bool:
    """Return whether bars can move: on a terminal, and in a notebook that can replace what it shows (``ipywidgets``)."""
    return console.is_terminal or (console.is_jupyter and importlib.util.find_spec("ipywidgets") is not None)


class Bar:
    """Something that goes on. ``advance()`` moves it; its total is None where nobody knows how much there is to do."""

    def __init__(self, label: str, total: float | None, done: float = 0):
        self._label, self._total, self._done = label, total, done
        self._first, self._since, self._note = done, time.monotonic(), ""

    def advance(self, steps: float = 1, note: str | None = None) -> None:
        """Move the bar by ``steps``; ``note`` replaces the text at its end."""
        self._done += steps
        self._note = self._note if note is None else note

    @property
    def line(self) -> str:
        """Where it is, in words."""
        spent, moved = time.monotonic() - self._since, self._done - self._first
        if self._total is None:
            return f"{self._label}: {format_duration(spent)} so far"
        left = f", {format_duration((self._total - self._done) * spent / moved)} left" if moved > 0 else ""
        return f"{self._label}: {self._done:g} of {self._total:g}{left}  {self._note}".rstrip()


class _LiveBar(Bar):
    """One that is drawn."""

    def __init__(self, progress: Progress, label: str, total: float | None, done: float):
        super().__init__(label, total, done)
        self._progress = progress
        self._task = progress.add_task(label, total=total, completed=done, note="")  # type: ignore[arg-type]

    def advance(self, steps: float = 1, note: str | None = None) -> None:
        fields = {} if note is None else {"note": note}
        self._progress.update(self._task, advance=steps, **fields)  # type: ignore[arg-type]

    def end(self) -> None:
        """Let it rest: it stays to be seen with the time that it took."""
        if self._total is None:
            self._progress.update(self._task, total=0)  # a full bar
        self._progress.stop_task(self._task)


class _Known(ProgressColumn):
    """Another column where there is a total, and nothing where there is none."""

    def __init__(self, column: ProgressColumn):
        super().__init__()
        self._column = column

    def render(self, task: Task) -> Text:
        return Text() if not task.total else self._column.render(task)  # type: ignore[return-value]


class _Lines:
    """Says every ``LINE_SECONDS`` seconds where the innermost of the bars is that were begun and have not ended."""

    def __init__(self) -> None:
        self.bars: list[Bar] = []
        self._ended = threading.Event()

    def begin(self, bar: Bar) -> None:
        """Tell of this one from now on."""
        self.bars.append(bar)
        if len(self.bars) == 1:
            self._ended = threading.Event()
            threading.Thread(target=self._tell, args=(self._ended,), daemon=True).start()

    def end(self, bar: Bar) -> None:
        """Tell of the one round it again, if there is one."""
        self.bars.remove(bar)
        if not self.bars:
            self._ended.set()

    def _tell(self, ended: threading.Event) -> None:
        while not ended.wait(LINE_SECONDS):
            with contextlib.suppress(IndexError, OSError):  # it has just ended; nobody reads any longer
                _print(self.bars[-1].line)


_lines = _Lines()


def describe_progress() -> str | None:
    """Return where the innermost thing is that goes on, in words; None where nothing does, or bars are drawn."""
    with contextlib.suppress(IndexError):
        return _lines.bars[-1].line
    return None


_shown: list[Progress] = []
"""What is drawn now: bars inside others are drawn below them."""


@contextlib.contextmanager
def progress_bar(label: str, total: float | None, done: float = 0) -> Iterator[Bar]:
    """A bar with the time left. Where nothing can move, a line tells the start, and one every ``LINE_SECONDS`` how far."""
    if _parts:
        yield Bar(label, total, done)
        return
    if not is_live():
        report(f"{label} ...")
        bar = Bar(label, total, done)
        _lines.begin(bar)
        try:
            yield bar
        finally:
            _lines.end(bar)
        return
    with contextlib.nullcontext(_shown[-1]) if _shown else _draw() as progress:
        drawn = _LiveBar(progress, label, total, done)
        try:
            yield drawn
        finally:
            drawn.end()


@contextlib.contextmanager
def _draw() -> Iterator[Progress]:
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        _Known(MofNCompleteColumn()),
        TimeElapsedColumn(),
        _Known(TimeRemainingColumn()),
        TextColumn("{task.fields[note]}"),
        console=console,
    ) as progress:
        _shown.append(progress)
        try:
            yield progress
        finally:
            _shown.remove(progress)


def spinner(label: str) -> contextlib.AbstractContextManager[Bar]:
    """Return a bar that moves as long as something goes on of which nobody knows how long it takes; bars may be inside."""
    return progress_bar(label, None)


def track(items: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
    """Iterate over ``items`` under a progress bar; ``total`` is their number where they are still being made."""
    if total is None:
        items = list(items)
        total = len(items)
    with progress_bar(label, total) as bar:
        for item in items:
            yield item
            bar.advance()
