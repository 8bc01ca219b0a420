"""Several of one kind at once, in order: pictures that are rendered and scored by one thread each."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import numba

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 1
"""Results beyond those in work that may wait for whoever takes them."""


def in_threads(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """``map`` in several threads: the results come in the order of the items, a few of which are worked on ahead.

    Kernels with parallel loops give each thread its share of the processor's. What is computed does not depend on that, and two
    pictures at once are done sooner than two after another: not all that a picture needs is a kernel.

    Args:
        function: lets others run while it computes, as kernels, NumPy and OpenCV do.
        items: taken by the thread that asks for results.
        threads: how many; with one, nothing is done ahead, in the thread that asks.

    Raises:
        whatever ``function`` raises, when its result is asked for; the rest is not begun then.
    """
    if threads < 2:
        yield from map(function, items)
        return
    share = max(numba.get_num_threads() // threads, 1)
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads, "flowsplat", numba.set_num_threads, (share,)) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > threads + AHEAD:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
