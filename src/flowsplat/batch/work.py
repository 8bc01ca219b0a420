"""A piece of work, how it is done in a process of its own, and what does many at a time."""

from __future__ import annotations

import errno
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from flowsplat.batch.records import Outcome
from flowsplat.common.errors import InputError, InUseError, WritingError, first_line
from flowsplat.common.memory import peak_memory
from flowsplat.common.progress import report


class Attempt(Protocol):
    """What a piece of work knows of the attempt that it is."""

    fewer: bool
    """Whether it may only take less memory than it would: it has outgrown what it had."""

    def needs(self, gib: float) -> None:
        """Say how much memory will be taken; returns when there is so much."""


Call = Callable[[Attempt], Mapping[str, Any]]


@dataclass(frozen=True)
class Job:
    """A piece of work.

    Attributes:
        id: the name of its record; one that ``plain_name`` lets through.
        key: a short name of everything that its result depends on: with another one it is done again.
        call: does it and returns what is to be told of it; it is sent to another process. May raise an InputError.
    """

    id: str
    key: str
    call: Call


@dataclass(frozen=True)
class Ended:
    """An attempt that has ended."""

    job: Job
    outcome: Outcome


@dataclass(frozen=True)
class Running:
    """What is known of an attempt that goes on.

    Attributes:
        doing: where it is, in words.
        seconds: since when.
        gib: memory that it holds; None where nobody knows.
    """

    id: str
    doing: str
    seconds: float
    gib: float | None


class Engine(Protocol):
    """Does pieces of work, each in a process of its own."""

    def has_room(self) -> bool:
        """Whether another one can be started now."""

    def start(self, job: Job, fewer: bool) -> None:
        """Begin an attempt."""

    def wait(self, seconds: float) -> Sequence[Ended]:
        """What has ended; waits at most so long for something to end."""

    def list_running(self) -> Sequence[Running]:
        """What goes on."""

    def drop(self, name: str) -> None:
        """End an attempt at once; nothing is told of it."""

    def stop(self) -> Sequence[Ended]:
        """Ask everything to keep what it has done and to end, and wait for that."""


def outcome_of(call: Call, attempt: Attempt) -> Outcome:
    """Do a piece of work in this process, whatever becomes of it. What is a mistake of ours is said with its traceback."""
    began = time.monotonic()

    def ended(how: Any, reason: str = "", result: Mapping[str, Any] | None = None) -> Outcome:
        return Outcome(how, reason, result, round(time.monotonic() - began, 2), peak_memory())

    try:
        return ended("done", result=call(attempt))
    except WritingError as error:
        return ended("unwritable", str(error))
    except InUseError as error:
        return ended("busy", str(error))
    except InputError as error:
        return ended("refused", str(error))
    except KeyboardInterrupt:
        return ended("stopped", "it was asked to stop")
    except MemoryError:
        return ended("outgrew", "it asked for more memory than there is")
    except Exception as error:
        report(traceback.format_exc())
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return ended("unwritable", f"The disk is full: {first_line(error)}.")
        if isinstance(error, RuntimeError) and ("out of memory" in str(error) or "allocate memory" in str(error)):  # of torch
            return ended("outgrew", "it asked for more memory than there is")
        return ended("crashed", f"{type(error).__name__}: {first_line(error)}")
