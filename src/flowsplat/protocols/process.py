"""One process a run: its peak memory is its own, and nothing of it stays behind."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import ParamSpec, TypeVar

from flowsplat.common.errors import InputError

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def in_own_process(function: Callable[Parameters, Result], *args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
    """Call a function of a module in a fresh process, and return or raise what it does. It ends when this one does.

    Raises:
        InputError: the process was killed.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=end_with_parent) as processes:
        try:
            return processes.submit(function, *args, **kwargs).result()
        except BrokenProcessPool as error:
            raise InputError("its process was killed, most likely because memory ran out.") from error


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
