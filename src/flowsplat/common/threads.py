"""Several of one kind at once, in order: pictures that are rendered and scored by one thread each."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
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


def computed_once(function: Callable[[int], Result], most: int) -> Callable[[int], Result]:
    """As ``functools.lru_cache``, for threads that ask together: who asks for what another computes waits for it.

    Args:
        function: of frames, say. What it asks of itself through others must not lead back to the same.
        most: results that are kept, those that were last asked for.
    """
    kept: OrderedDict[int, Future[Result]] = OrderedDict()
    lock = threading.Lock()

    def result(k: int) -> Result:
        with lock:
            known = kept.get(k)
            future = kept[k] = known or Future()
            kept.move_to_end(k)
            if len(kept) > most:
                kept.popitem(last=False)
        if known is None:
            try:
                future.set_result(function(k))
            except BaseException as error:
                with lock:
                    if kept.get(k) is future:
                        del kept[k]
                future.set_exception(error)
        return future.result()

    return result
