"""Measuring on a machine that others use too: everything that is compared takes turns, minimum and median are kept."""

from __future__ import annotations

import contextlib
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch

from flowsplat.common.threads import set_thread_count

Job = Callable[[], Mapping[str, float]]
"""Does something once and returns the seconds of its parts by name."""


def summarize_timing(seconds: list[float]) -> dict[str, float]:
    """How repeated measurements enter the result."""
    return {
        "min_ms": significant(min(seconds) * 1e3),
        "median_ms": significant(statistics.median(seconds) * 1e3),
        "repeats": len(seconds),
    }


def significant(value: float) -> float:
    """Four significant digits."""
    return float(f"{value:.4g}")


def interleave(jobs: Mapping[str, Job], repeat: int, warm_up: int = 1) -> dict[str, dict[str, dict[str, float]]]:
    """Run all jobs once a round, for ``repeat`` rounds after those that warm up.

    Returns:
        by job and part: ``summarize_timing``. Jobs that return no parts are left out.
    """
    seconds: dict[str, dict[str, list[float]]] = {}
    for round_ in range(-warm_up, repeat):
        for name, job in jobs.items():
            parts = job()
            if round_ >= 0:
                for part, value in parts.items():
                    seconds.setdefault(name, {}).setdefault(part, []).append(value)
    return {name: {part: summarize_timing(values) for part, values in parts.items()} for name, parts in seconds.items()}


def use_threads(count: int) -> None:
    """Let the kernels and torch use this many threads from now on."""
    set_thread_count(count)
    torch.set_num_threads(count)


@contextlib.contextmanager
def replace_attribute(owner: Any, name: str, value: Any) -> Iterator[None]:
    """``owner.name`` is ``value`` for a while."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


def tell(message: str) -> None:
    """One line for the person who waits."""
    print(message, file=sys.stderr, flush=True)
