"""The clock of a measurement."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock


@contextmanager
def by_the_processor() -> Iterator[None]:
    """Let ``time.perf_counter``, which stages and trainings read, count the seconds of this process's processor: other work on the
    machine does not count then. Of several threads each one's seconds count."""
    with mock.patch.object(time, "perf_counter", time.process_time):
        yield


def read_clock() -> float:
    """Return ``time.perf_counter()``; within ``by_the_processor`` with the seconds of the processes that were begun here and have
    ended. Windows does not tell these."""
    ended = os.times() if time.perf_counter is time.process_time else None
    return time.perf_counter() + (0.0 if ended is None else ended.children_user + ended.children_system)
