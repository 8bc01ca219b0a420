"""One process a run: its peak memory is its own, and nothing of it stays behind."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
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
def own_processes(count: int, begin: Callable[[], None] = end_with_parent) -> Iterator[ProcessPoolExecutor]:
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
        InputError: as ``own_processes``.
    """
    with own_processes(1) as processes:
        return processes.submit(function, *args, **kwargs).result()
