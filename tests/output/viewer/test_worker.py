"""One thread renders for all clients."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from flowsplat.output.viewer import worker as module
from flowsplat.output.viewer.browser_frame import BrowserFrame
from flowsplat.output.viewer.drawing import Drawing
from flowsplat.output.viewer.session import ImageJob, Session
from flowsplat.output.viewer.source import Source
from flowsplat.output.viewer.worker import Worker

LONGEST = 60
"""Seconds after which a test that waits has failed."""


class Events:
    """What happened, in order; the test waits until enough did."""

    def __init__(self) -> None:
        self._happened: list = []
        self._changed = threading.Condition()

    def append(self, event) -> None:
        with self._changed:
            self._happened.append(event)
            self._changed.notify_all()

    def wait(self, enough: Callable[[list], bool]) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: enough(self._happened), LONGEST), "waited in vain"

    def more(self, count: int) -> None:
        """Wait until ``count`` more happened than have by now."""
        end = len(self) + count
        self.wait(lambda happened: len(happened) >= end)

    def __len__(self) -> int:
        with self._changed:
            return len(self._happened)

    def __iter__(self) -> Iterator:
        with self._changed:
            return iter(list(self._happened))


class ObservedLock(threading.Condition):
    """The worker's lock, which counts how often the worker's thread has come to it, and whether it got it or not."""

    def __init__(self) -> None:
        super().__init__(threading.RLock())
        self.approaches = Events()
        self.of: threading.Thread | None = None

    def __enter__(self) -> bool:
        if threading.current_thread() is self.of:
            self.approaches.append(True)
        return super().__enter__()


@pytest.fixture
def worker(run_folder):
    found = Worker(Source(run_folder))
    found.start()
    yield found
    found.stop()


def client(
    worker: Worker, number: int, run_folder: Path, images: Events, playing: bool = True, shown: Callable[[], None] = lambda: None
) -> Session:
    source = Source(run_folder)
    session = Session(source.clip, 64)
    session.move(BrowserFrame(source.scene.similarity).pose(source.path.at(0.0)), (64, 48), time.monotonic())
    session.clock.play(playing, time.monotonic())

    def show(job: ImageJob, drawing: Drawing) -> None:
        images.append((job, drawing, threading.get_ident()))
        shown()

    worker.add(number, session, show)
    return session


def test_all_clients_are_served_by_one_thread(worker, run_folder):
    first, second = Events(), Events()
    client(worker, 1, run_folder, first)
    client(worker, 2, run_folder, second)
    first.more(5)
    second.more(5)
    assert len({thread for *_, thread in [*first, *second]}) == 1
    worker.remove(1)
    second.more(2)  # by now the image that was under way when it left has been shown
    left = len(first)
    second.more(5)
    assert len(first) == left


def test_tasks_advance_between_images_and_end_with_their_client(worker, run_folder):
    images, steps, closed = Events(), Events(), threading.Event()

    def task():
        try:
            while True:
                steps.append(len(images))
                yield
        finally:
            closed.set()

    client(worker, 1, run_folder, images)
    worker.begin(1, task())
    steps.wait(lambda seen: len(seen) > 10 and seen[-1] > seen[0] + 3)
    worker.remove(1)
    assert closed.wait(LONGEST)


def test_a_client_with_a_task_may_leave_at_any_moment(run_folder):
    """The client leaves when the worker, done with its image, is about to take its task."""
    images, others, steps, closed = Events(), Events(), Events(), threading.Event()
    worker = Worker(Source(run_folder))
    worker._condition = lock = ObservedLock()
    lock.of = worker._thread
    is_shown, is_held = threading.Event(), threading.Event()

    def shown() -> None:
        is_shown.set()
        assert is_held.wait(LONGEST)

    def task():
        try:
            yield
            steps.append(True)
        finally:
            closed.set()

    begun = task()
    next(begun)
    client(worker, 1, run_folder, images, shown=shown)
    worker.begin(1, begun)
    worker.start()
    try:
        assert is_shown.wait(LONGEST)
        with worker.change():
            before = len(lock.approaches)
            is_held.set()
            lock.approaches.wait(lambda seen: len(seen) > before)
            worker.remove(1)
        assert closed.wait(LONGEST)
        client(worker, 2, run_folder, others)
        others.more(3)
    finally:
        is_held.set()
        worker.stop()
    assert len(images) == 1
    assert len(steps) == 0


def test_what_fails_for_one_client_does_not_stop_the_others(worker, run_folder, monkeypatch):
    whole, good, bad, said = module.draw, Events(), Events(), Events()

    def draw(source, browser, wish):
        if wish.size == (10, 10):
            raise RuntimeError("no such image")
        return whole(source, browser, wish)

    monkeypatch.setattr(module, "draw", draw)
    monkeypatch.setattr(module, "report", said.append)
    broken = client(worker, 1, run_folder, bad, playing=False)
    with worker.change():
        broken.move(broken.pose, (10, 10), time.monotonic())

    def failing():
        raise RuntimeError("no such task")
        yield

    worker.begin(1, failing())
    said.wait(lambda lines: any("no such image" in line for line in lines))
    said.wait(lambda lines: any("no such task" in line for line in lines))
    client(worker, 2, run_folder, good)
    good.more(5)
    assert not [job for job, *_ in bad if job.wish.size == (10, 10)]


def test_trouble_with_a_newer_model_is_told_once_and_all_goes_on(run_folder, monkeypatch):
    source, images, said, looks = Source(run_folder), Events(), Events(), Events()

    def refresh() -> bool:
        looks.append(True)
        if len(looks) == 1:
            return True
        raise OSError("no such model")

    def reloaded() -> None:
        raise RuntimeError("no such panel")

    monkeypatch.setattr(source, "refresh", refresh)
    monkeypatch.setattr(module, "report", said.append)
    monkeypatch.setattr(module, "_MODEL_CHECK_INTERVAL", 0.0)
    worker = Worker(source, reloaded)
    client(worker, 1, run_folder, images)
    worker.start()
    try:
        said.wait(lambda lines: any("no such model" in line for line in lines))
        images.more(3)
        looks.more(3)
        images.more(3)
    finally:
        worker.stop()
    for what in ("no such panel", "no such model"):
        assert len([line for line in said if what in line]) == 1
