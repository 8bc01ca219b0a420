"""One way to show progress: rich bars with the time that is left, on stderr, quiet away from a terminal."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

Item = TypeVar("Item")

console = Console(stderr=True, highlight=False)


def say(message: str) -> None:
    """Print one line on stderr."""
    console.print(message, markup=False, soft_wrap=True)


@functools.cache
def say_once(message: str) -> None:
    """Print one line, the first time only that it is to be said."""
    say(message)


class Bar:
    """A running progress bar: ``advance()`` moves it, ``note`` changes the text behind it."""

    def __init__(self, progress: Progress, task: TaskID):
        self._progress, self._task = progress, task

    def advance(self, steps: float = 1, note: str | None = None) -> None:
        """Move the bar by ``steps``; ``note`` replaces the text at its end."""
        fields = {} if note is None else {"note": note}
        self._progress.update(self._task, advance=steps, **fields)  # type: ignore[arg-type]


@contextlib.contextmanager
def progress_bar(label: str, total: float, done: float = 0) -> Iterator[Bar]:
    """A bar with the time left. Away from a terminal a single line tells the start and nothing flickers."""
    if not console.is_terminal:
        say(f"{label} ...")
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
        disable=not console.is_terminal,
    ) as progress:
        yield Bar(progress, progress.add_task(label, total=total, completed=done, note=""))  # type: ignore[arg-type]


def track(items: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
    """Iterate over ``items`` under a progress bar; ``total`` is their number where they are still being made."""
    if total is None:
        items = list(items)
        total = len(items)
    with progress_bar(label, total) as bar:
        for item in items:
            yield item
            bar.advance()
