"""Start a process for each run: its peak memory is its own, and nothing of it stays behind; and how many cores there are for
them."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import ParamSpec, TypeVar

from flowsplat.common.errors import InputError, first_line

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def end_with_parent() -> None:
    """To be called first in a new process.

    Without this, a training would go on after the command that asked for it was killed.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextlib.contextmanager
def start_processes(count: int, begin: Callable[[], None] = end_with_parent) -> Iterator[ProcessPoolExecutor]:
    """Up to ``count`` fresh processes that take on what is submitted.

    Args:
        begin: is called first in each; a function of a module that calls ``end_with_parent``.

    Raises:
        InputError: the system has no semaphores for them (Linux: no ``/dev/shm`` that can be written), or one of them was killed.
    """
    try:
        processes = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), begin)
    except (OSError, NotImplementedError, ImportError) as error:  # by the system
        reason = error.strerror if isinstance(error, OSError) else first_line(error)
        message = f"No processes of their own can be started here ({reason}): is there a /dev/shm, and room in it?"
        raise InputError(message) from error
    with processes:
        try:
            yield processes
        except BrokenProcessPool as error:
            raise InputError("a process was killed, most likely because memory ran out: the same command continues.") from error
        except BaseException:
            processes.shutdown(wait=False, cancel_futures=True)
            raise


def in_own_process(function: Callable[Parameters, Result], *args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
    """Call a function of a module in a fresh process, and return or raise what it does. It ends when this one does.

    Raises:
        InputError: as ``start_processes``.
    """
    with start_processes(1) as processes:
        return processes.submit(function, *args, **kwargs).result()


def usable_cores() -> int:
    """Cores that this process may use: those of the machine, less what it was bound to, or its container is limited to."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    with contextlib.suppress(OSError, ValueError):  # "max" is no limit
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        cores = min(cores, max(1, int(quota) // int(period)))
    return cores


THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""How many threads a process computes with that is started with them; later they are not looked at."""


@contextlib.contextmanager
def threads_of_new_processes(count: int) -> Iterator[None]:
    """Processes that are started inside compute with so many threads. Results do not depend on it."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(count)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
