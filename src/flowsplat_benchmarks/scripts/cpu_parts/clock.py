"""Where the time goes inside a call, without a hook in the package."""

from __future__ import annotations

import contextlib
import cProfile
import functools
import inspect
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from numba.core.dispatcher import Dispatcher

import flowsplat
from flowsplat.common.threads import parallel_for
from flowsplat_benchmarks.scripts.cpu_parts.timing import replace_attribute

PACKAGE = Path(flowsplat.__file__).parent


class KernelClock:
    """Adds up the seconds spent in the Numba kernels of a package, by swapping them for timed ones for a while.

    Only calls from Python are seen, not those from one kernel to another. The kernels must have run before: one that is compiled
    while its helpers are swapped cannot find them.
    """

    def __init__(self, package: str, names: dict[str, str]):
        """Find the kernels.

        Args:
            package: dotted name; its modules must be loaded.
            names: what to call a kernel; one that is not in it keeps its own name.
        """
        modules = [module for name, module in sys.modules.items() if name == package or name.startswith(package + ".")]
        self._names = names
        self._kernels = [
            (names.get(attribute, attribute), module, attribute)
            for module in modules
            for attribute, value in vars(module).items()
            if isinstance(value, Dispatcher) and not _takes_a_range(value)
        ]
        self._launches = [module for module in modules if vars(module).get("parallel_for") is parallel_for]
        self._seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def run(self) -> Iterator[None]:
        """Watch for as long as this lasts."""
        with contextlib.ExitStack() as stack:
            for name, module, attribute in self._kernels:
                stack.enter_context(replace_attribute(module, attribute, self._time(name, getattr(module, attribute))))
            for module in self._launches:
                stack.enter_context(replace_attribute(module, "parallel_for", self._launch))
            yield

    def take(self) -> dict[str, float]:
        """The seconds by name since the last time."""
        seconds, self._seconds = self._seconds, {}
        return seconds

    def _launch(self, kernel: Callable[..., Any], *args: Any, **how: Any) -> None:
        name = kernel.__name__
        self._time(self._names.get(name, name), parallel_for)(kernel, *args, **how)

    def _time(self, name: str, kernel: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(kernel)
        def call(*args: Any, **how: Any) -> Any:
            start = time.perf_counter()
            result = kernel(*args, **how)
            self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - start
            return result

        return call


def _takes_a_range(kernel: Any) -> bool:
    """Whether it is ``parallel_for`` that calls it."""
    return str(kernel.py_func.__code__.co_varnames[0]).startswith("begin")


def profile(action: Callable[[], object], directors: Sequence[str]) -> dict[str, float]:
    """Run ``action`` under Python's profiler and sum up what it spends where.

    Args:
        action: what to run; on one Python thread.
        directors: files of the package (``training/trainer.py``) that only call others.

    Returns:
        seconds by part: the functions of the package that a director calls, the gradients of the package's autograd functions, what
        torch does besides in its backward pass, and the ``rest``: the directors themselves and the torch operations in them.
    """
    profiler = cProfile.Profile()
    start = time.perf_counter()
    profiler.runcall(action)
    total = time.perf_counter() - start
    profiler.create_stats()
    files = {str(PACKAGE / name) for name in directors}
    gradients = _gradients()
    parts: dict[str, float] = {}
    backward = 0.0
    for (file, line, name), (_, _, _, cumulative, callers) in profiler.stats.items():
        if (file, line) in gradients:
            label = f"gradient of {gradients[file, line]}"
            parts[label] = parts.get(label, 0.0) + cumulative
        elif file.startswith(str(PACKAGE)) and file not in files:
            # A function under ``torch.no_grad()`` is called by torch's wrapper round it.
            by_director = [key for key in callers if key[0] in files or key[2] == "decorate_context"]
            seconds = sum(callers[key][3] for key in by_director)
            if seconds:
                label = f"{_subject(file)}: {name}"
                parts[label] = parts.get(label, 0.0) + seconds
        elif name.startswith("<method 'run_backward'"):
            backward += cumulative
    parts["other gradients"] = backward - sum(value for name, value in parts.items() if name.startswith("gradient of "))
    return {**parts, "rest": total - sum(parts.values())}


def _subject(file: str) -> str:
    """What a file is about: its name, or its folder's where that is only ``api``, ``cpu``, ..."""
    path = Path(file)
    return path.parent.name if path.stem in ("api", "cpu", "reference", "__init__") else path.stem


def _gradients() -> dict[tuple[str, int], str]:
    """(file, line) of the backward methods of the package's autograd functions, and what they differentiate."""
    found, waiting = {}, list(torch.autograd.Function.__subclasses__())
    while waiting:
        kind = waiting.pop()
        waiting += kind.__subclasses__()
        if kind.__module__.startswith("flowsplat."):
            code = inspect.unwrap(kind.backward).__code__
            found[code.co_filename, code.co_firstlineno] = re.sub("(?<=[a-z])(?=[A-Z])", " ", kind.__name__.lstrip("_")).lower()
    return found
