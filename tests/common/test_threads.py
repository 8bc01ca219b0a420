"""Ranges of a kernel in several threads, and several of one kind at once, in order."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from flowsplat.common import threads
from flowsplat.common.kernels import kernel
from flowsplat.common.threads import (
    compute_once,
    core_left_to,
    get_max_threads,
    in_one_launch,
    in_threads,
    parallel_for,
    set_thread_count,
    thread_count,
)
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Similarity
from tests.training.handful import a_few, seen, tiny

pytestmark = pytest.mark.all_cores


@kernel
def _add_one(begin, end, values, counts):
    for i in range(begin, end):
        values[i] += 1
        counts[begin] += 1


@kernel
def _slow(begin, end, values):
    for i in range(begin, end):
        for k in range(200_000):
            values[i] += 1.0 / (k + values[i])


@pytest.fixture(params=["OpenMP", "Python"])
def kind(request, monkeypatch):
    """The threads of torch, and threads of our own."""
    if request.param == "Python":
        monkeypatch.setattr(threads, "_team", lambda: None)
    elif threads._team() is None:
        pytest.skip("torch computes without OpenMP here")
    return request.param


@pytest.mark.parametrize("count", [0, 1, 2, 7, 1000])
def test_ranges_cover_everything_once(kind, count):
    values, counts = np.zeros(count), np.zeros(count)
    parallel_for(_add_one, count, values, counts)
    assert (values == 1).all()
    assert counts.sum() == count
    if count == 1000 and thread_count() > 1:
        assert (counts > 0).sum() == threads.RANGES_PER_THREAD * thread_count()


def test_with_one_thread_it_is_one_call():
    def work() -> int:
        set_thread_count(1)
        values, counts = np.zeros(1000), np.zeros(1000)
        parallel_for(_add_one, 1000, values, counts)
        return int((counts > 0).sum())

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(work).result() == 1


def test_more_threads_than_there_are_cannot_be_asked_for():
    for count in (0, get_max_threads() + 1):
        with pytest.raises(ValueError, match="there are 1 to"):
            set_thread_count(count)


def test_several_loops_in_one_launch(kind, monkeypatch):
    launches, run = [], threads._run
    monkeypatch.setattr(threads, "_run", lambda jobs: (launches.append(len(jobs)), run(jobs)))
    every = [np.zeros(count) for count in (5, 0, 300, 1)]
    with in_one_launch():
        for values in every:
            parallel_for(_add_one, len(values), values, np.zeros_like(values))
        assert not any(values.any() for values in every), "nothing is run before the end"
    assert all((values == 1).all() for values in every)
    assert launches == [3]

    def fails() -> None:
        with in_one_launch():
            parallel_for(_add_one, 5, every[0], every[0])
            raise KeyError

    with pytest.raises(KeyError):
        fails()
    assert (every[0] == 1).all(), "nor after an error"
    parallel_for(_add_one, 5, every[0], np.zeros(5))
    assert (every[0] == 2).all()


def test_an_error_of_a_range_arrives_and_ends_the_rest(kind):
    done = []

    def spoilt(begin: int, end: int) -> None:
        done.append(begin)
        if begin == 0:
            raise IndexError("spoilt")
        time.sleep(0.01)

    with pytest.raises(IndexError, match="spoilt"):
        parallel_for(spoilt, 1000, pieces=100)
    assert len(done) < 50
    values = np.zeros(10)
    parallel_for(_add_one, 10, values, np.zeros(10))
    assert (values == 1).all()


@pytest.mark.skipif(get_max_threads() < 2, reason="one thread takes all in one range")
def test_an_interrupt_is_not_held_up(kind):
    """Ctrl-C ends a loop after the ranges in work, not after all of them."""
    parallel_for(_slow, 2, np.ones(2))  # compiles
    values = np.ones(20_000)
    timer = threading.Timer(0.2, signal.raise_signal, [signal.SIGINT])
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        parallel_for(_slow, len(values), values, pieces=1000)
    assert (values[0] > 1, values[-1]) == (True, 1)
    timer.join()


def test_a_core_is_left_to_a_process_as_long_as_it_lives():
    before = thread_count(), cv2.getNumThreads()
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    try:
        with core_left_to(process):
            assert (thread_count(), cv2.getNumThreads()) == tuple(max(count - 1, 1) for count in before)
            process.terminate()
            deadline = time.monotonic() + 30
            while thread_count() < before[0] and time.monotonic() < deadline:
                time.sleep(0.01)
            assert (thread_count(), cv2.getNumThreads()) == before
        assert thread_count() == before[0], "it is given back once"
    finally:
        process.kill()
        process.wait()
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]) as other:
        with core_left_to(other):
            pass
        assert thread_count() == before[0], "at the end of the block at the latest"
        other.kill()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes are forked here")
def test_a_forked_process_computes_too():
    values = np.zeros(1000)
    parallel_for(_add_one, 1000, values, np.zeros(1000))
    child = os.fork()
    if child == 0:
        parallel_for(_add_one, 1000, values, np.zeros(1000))
        os._exit(0 if (values == 2).all() and threads.kind_of_threads() == "Python" else 1)
    deadline = time.monotonic() + 30
    while (ended := os.waitpid(child, os.WNOHANG))[0] == 0:
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.01)
    assert ended[1] == 0
    parallel_for(_add_one, 1000, values, np.zeros(1000))
    assert (values == 2).all()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_results_come_in_order(threads):
    assert list(in_threads(lambda x: x * x, range(20), threads)) == [x * x for x in range(20)]
    assert list(in_threads(lambda x: x, [], threads)) == []


def test_two_are_worked_on_at_once_each_with_its_share_of_the_processor():
    together, share = threading.Barrier(2, timeout=10), max(thread_count() // 2, 1)

    def work(_: int) -> int:
        together.wait()
        return thread_count()

    assert list(in_threads(work, range(4), 2)) == [share] * 4


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_arrives_where_the_result_is_asked_for_and_ends_the_rest(threads):
    begun = []

    def work(x: int) -> int:
        begun.append(x)
        if x == 2:
            raise RuntimeError("spoilt")
        return x

    results = in_threads(work, range(1000), threads)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(RuntimeError, match="spoilt"):
        next(results)
    assert len(begun) < 20


def test_what_several_threads_ask_for_is_computed_once_and_kept_while_there_is_room():
    asked, together = [], threading.Barrier(2, timeout=10)

    def slow(k: int) -> int:
        asked.append(k)
        return k * k

    kept = compute_once(slow, 2)

    def work(_: int) -> list[int]:
        together.wait()
        return [kept(k) for k in (1, 2)]

    assert list(in_threads(work, range(2), 2)) == [[1, 4], [1, 4]]
    assert sorted(asked) == [1, 2]
    assert [kept(3), kept(2), kept(1)] == [9, 4, 1]
    assert sorted(asked) == [1, 1, 2, 3], "the one not asked for longest is forgotten"


def test_what_failed_is_computed_again():
    asked = []

    def work(k: int) -> int:
        asked.append(k)
        if len(asked) == 1:
            raise RuntimeError("spoilt")
        return k

    kept = compute_once(work, 2)
    with pytest.raises(RuntimeError, match="spoilt"):
        kept(5)
    assert kept(5) == 5
    assert asked == [5, 5]


def test_images_are_the_same_however_many_are_rendered_at_once():
    config = tiny("default")
    gaussians = a_few(config)
    model = SceneModel(gaussians, Similarity(), 0.0, 1.0)
    camera = seen(gaussians)[0].camera

    def image(k: int) -> bytes:
        shown = model.render(camera, k / 8, (camera, (k + 1) / 8))
        assert shown.flow is not None
        return shown.color.tobytes() + shown.flow.tobytes()

    alone, together = (list(in_threads(image, range(8), threads)) for threads in (1, 3))
    assert alone == together
    assert len(set(alone)) == 8
