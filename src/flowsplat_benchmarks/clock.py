"""The clock of a measurement."""

from __future__ import annotations

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
