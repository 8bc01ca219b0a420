"""One thread renders for all clients."""

from __future__ import annotations

import threading
import time

import pytest

from flowsplat.output.viewer import worker as module
from flowsplat.output.viewer.browser_frame import BrowserFrame
from flowsplat.output.viewer.session import Session
from flowsplat.output.viewer.source import Source
from flowsplat.output.viewer.worker import Worker


@pytest.fixture
def worker(run_folder):
    found = Worker(Source(run_folder))
    found.start()
    yield found
    found.stop()


def wait(what) -> None:
    end = time.monotonic() + 30
    while not what():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def client(worker: Worker, number: int, run_folder, pictures: list, playing: bool = True) -> Session:
    source = Source(run_folder)
    session = Session(source.clip, 64)
    session.move(BrowserFrame(source.scene.similarity).pose(source.path.at(0.0)), (64, 48), time.monotonic())
    session.clock.play(playing, time.monotonic())
    worker.add(number, session, lambda job, drawing: pictures.append((job, drawing, threading.get_ident())))
    return session


def test_all_clients_are_served_by_one_thread(worker, run_folder):
    first, second = [], []
    client(worker, 1, run_folder, first)
    client(worker, 2, run_folder, second)
    wait(lambda: len(first) > 5 and len(second) > 5)
    assert len({thread for *_, thread in first + second}) == 1
    worker.remove(1)
    time.sleep(0.1)
    left, going = len(first), len(second)
    wait(lambda: len(second) > going + 5)
    assert len(first) == left


def test_tasks_advance_between_pictures_and_end_with_their_client(worker, run_folder):
    pictures, steps, closed = [], [], []

    def task():
        try:
            while True:
                steps.append(len(pictures))
                time.sleep(0.01)
                yield
        finally:
            closed.append(True)

    client(worker, 1, run_folder, pictures)
    worker.begin(1, task())
    wait(lambda: len(steps) > 10 and steps[-1] > steps[0] + 3)
    worker.remove(1)
    wait(lambda: closed)


def test_what_fails_for_one_client_does_not_stop_the_others(worker, run_folder, monkeypatch, capsys):
    whole, good, bad = module.draw, [], []

    def draw(source, browser, wish):
        if wish.size == (10, 10):
            raise RuntimeError("no such picture")
        return whole(source, browser, wish)

    monkeypatch.setattr(module, "draw", draw)
    broken = client(worker, 1, run_folder, bad, playing=False)
    with worker.changed():
        broken.move(broken.pose, (10, 10), time.monotonic())

    def failing():
        raise RuntimeError("no such task")
        yield

    worker.begin(1, failing())
    client(worker, 2, run_folder, good)
    wait(lambda: len(good) > 5)
    wait(lambda: "no such picture" in capsys.readouterr().err or len(good) > 200)
    assert not [job for job, *_ in bad if job.wish.size == (10, 10)]
