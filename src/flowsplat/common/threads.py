"""Work in several threads: ranges of a kernel's loop, and several of one kind at once, in order."""

from __future__ import annotations

import contextlib
import ctypes
import os
import subprocess
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from numba import config

Item = TypeVar("Item")
Result = TypeVar("Result")

RESULTS_AHEAD = 1
"""Results beyond those in work that may wait for whoever takes them. Chosen by eye."""
RANGES_PER_THREAD = 4
"""Ranges for each thread into which a loop is cut: where others need the processor, too, threads are not equally fast.
Chosen by eye."""

_own = threading.local()
_left_to_others = 0
"""Cores that other processes need for now."""
_counting = threading.Lock()


def get_max_threads() -> int:
    """``NUMBA_NUM_THREADS``, or as many as this process has cores."""
    return int(config.NUMBA_NUM_THREADS)


def thread_count() -> int:
    """Return how many threads the kernels have that the calling thread starts."""
    return max((getattr(_own, "count", None) or get_max_threads()) - _left_to_others, 1)


@contextlib.contextmanager
def core_left_to(process: subprocess.Popen[Any]) -> Iterator[None]:
    """Compute with one thread less for as long as another process needs a core, at most until the end of this.

    Threads that wait for each other would wait for the core that it has; what is computed does not depend on it.
    """
    taken = [1]

    def give_back() -> None:
        with _counting:
            _leave(-taken.pop() if taken else 0)

    def wait() -> None:
        process.wait()
        give_back()

    with _counting:
        _leave(taken[0])
    threading.Thread(target=wait, daemon=True, name="flowsplat waits").start()
    try:
        yield
    finally:
        give_back()


def _leave(cores: int) -> None:
    global _left_to_others
    open_cv_threads()  # before they are changed for the first time
    _left_to_others += cores
    restore_open_cv()


@cache
def open_cv_threads() -> int:
    """Return how many threads OpenCV has in this process where it need not leave any to others."""
    import cv2  # which a rasterizer alone does not need

    return int(cv2.getNumThreads())


def restore_open_cv() -> None:
    """Give OpenCV the threads that it may have now."""
    import cv2

    cv2.setNumThreads(max(open_cv_threads() - _left_to_others, 1))


def set_thread_count(count: int) -> None:
    """Give the kernels that the calling thread starts this many threads from now on."""
    if not 1 <= count <= get_max_threads():
        raise ValueError(f"{count} threads: there are 1 to {get_max_threads()}")
    _own.count = count


def kind_of_threads() -> str:
    """In which threads kernels run."""
    return "OpenMP" if _team() is not None else "Python"


def parallel_for(kernel: Callable[..., Any], count: int, *arguments: Any, pieces: int = RANGES_PER_THREAD) -> None:
    """Call ``kernel(begin, end, *arguments)`` for ranges that cover 0 to ``count``, in as many threads as the caller has.

    What it computes must not depend on how the ranges are cut. An interrupt (Ctrl-C) ends it after the ranges in work.

    Args:
        kernel: lets other threads run while it works (``common.kernels.kernel``).
        pieces: ranges for each thread.
    """
    if count < 1:
        return
    job = kernel, count, arguments, pieces
    waiting: list[_Job] | None = getattr(_own, "waiting", None)
    if waiting is None:
        _run([job])
    else:
        waiting.append(job)


@contextlib.contextmanager
def in_one_launch() -> Iterator[None]:
    """Loops of ``parallel_for`` inside are run when it ends, all at once: waking threads costs as much as a small loop.

    None of them may need what another one computes.
    """
    jobs: list[_Job] = []
    _own.waiting = jobs
    try:
        yield
    finally:
        _own.waiting = None
    _run(jobs)


_Job = tuple[Callable[..., Any], int, tuple[Any, ...], int]


def _run(jobs: list[_Job]) -> None:
    threads = thread_count()
    if threads < 2:
        for kernel, count, arguments, _ in jobs:
            kernel(0, count, *arguments)
        return
    left = deque(
        (kernel, count * k // total, count * (k + 1) // total, arguments)
        for kernel, count, arguments, pieces in jobs
        for total in [min(count, max(threads * pieces // len(jobs), 1))]
        for k in range(total)
    )
    errors: list[BaseException] = []

    def work() -> None:
        try:
            while left:
                try:
                    kernel, begin, end, arguments = left.popleft()
                except IndexError:  # Another thread took the last one.
                    return
                kernel(begin, end, *arguments)
        except BaseException as error:  # an interrupt, too: who called waits for the other threads before it goes on
            errors.append(error)
            left.clear()

    (_in_torchs_threads if _team() is not None else _in_own_threads)(work, min(threads, len(left)))
    if errors:
        raise errors[0]


# Threads that compute with OpenMP wait for more by counting, for some milliseconds, not asleep. A thread of our own would have to
# share a core with the one with which torch has just added two tensors; so the loop is given to torch's own.

_Callback = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
_working: dict[int, Callable[[], None]] = {}


@_Callback
def _enter(key: int | None) -> None:
    _working[key or 0]()


@cache
def _team() -> Any:
    """``GOMP_parallel`` of the OpenMP library that torch computes with, or None where there is none of that name."""
    import torch

    with contextlib.suppress(OSError, AttributeError):
        # A name is looked up in a library and in those that it was linked with.
        start = ctypes.CDLL(str(Path(torch.__file__).parent / "lib" / "libtorch_cpu.so")).GOMP_parallel
        start.argtypes, start.restype = (_Callback, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint), None
        return start
    return None


def _in_torchs_threads(work: Callable[[], None], threads: int) -> None:
    key = id(work)
    _working[key] = work
    try:
        _team()(_enter, key, threads, 0)
    finally:
        del _working[key]


def _in_own_threads(work: Callable[[], None], threads: int) -> None:
    helpers = [_workers().submit(work) for _ in range(threads - 1)]
    work()
    for helper in helpers:
        if not helper.cancel():
            helper.result()


_pool: ThreadPoolExecutor | None = None
_pool_lock = threading.Lock()


def _workers() -> ThreadPoolExecutor:
    global _pool
    with _pool_lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max(get_max_threads() - 1, 1), "flowsplat-kernels")
        return _pool


def _forget_threads() -> None:
    """A forked process has none of its parent's threads, and OpenMP would wait for them for ever."""
    global _pool, _pool_lock, _team
    _pool, _pool_lock, _team = None, threading.Lock(), lambda: None  # type: ignore[assignment]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_threads)


def in_threads(function: Callable[[Item], Result], items: Iterable[Item], threads: int) -> Iterator[Result]:
    """``map`` in several threads: the results come in the order of the items, a few of which are worked on ahead.

    Kernels (``parallel_for``) have each thread's share of the processor's. What is computed does not depend on that, and two
    images at once are done sooner than two after another: not all that an image needs is a kernel.

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
    share = max(thread_count() // threads, 1)
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads, "flowsplat", set_thread_count, (share,)) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > threads + RESULTS_AHEAD:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def compute_once(function: Callable[[int], Result], most: int) -> Callable[[int], Result]:
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
