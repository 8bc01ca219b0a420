"""Which image a client needs next."""

from __future__ import annotations

import numpy as np

from flowsplat.output.viewer.browser_frame import Pose
from flowsplat.output.viewer.session import Session

CANVAS = (1200, 900)
POSE = Pose(np.array([1.0, 0, 0, 0]), np.zeros(3), 1.0)
ELSEWHERE = Pose(np.array([1.0, 0, 0, 0]), np.ones(3), 1.0)


def session() -> Session:
    found = Session((0.0, 2.0), 1600)
    found.mode = "orbit"
    return found


def draw(session: Session, now: float, seconds: float = 0.05, model: int = 0):
    job = session.job(now, model)
    if job is not None:
        session.finish_image(job, now + seconds, seconds)
    return job


def test_nothing_is_drawn_for_a_client_without_a_window():
    assert session().job(0.0, 0) is None


def test_small_while_it_moves_full_when_still_then_nothing():
    client = session()
    client.move(POSE, CANVAS, 0.0)
    moving = draw(client, 0.0)
    assert not moving.is_still
    assert max(moving.wish.size) < max(CANVAS)
    assert draw(client, 0.1) is None
    still = draw(client, 0.4)
    assert still.is_still
    assert still.wish.size == CANVAS
    assert draw(client, 9.0) is None
    client.move(ELSEWHERE, CANVAS, 10.0)
    assert not draw(client, 10.0).is_still
    assert draw(client, 10.4).wish.pose is ELSEWHERE


def test_playing_shows_new_times_but_not_more_often_than_can_be_seen():
    client = session()
    client.move(POSE, CANVAS, 0.0)
    client.clock.play(True, 0.0)
    jobs = [job for k in range(1000) if (job := draw(client, k / 1000, 0.0)) is not None]
    assert 25 <= len(jobs) <= 31
    times = [job.wish.t for job in jobs]
    assert times == sorted(times)
    assert not any(job.is_still for job in jobs)
    assert client.is_restless(1.0)


def test_a_newer_model_is_drawn():
    client = session()
    client.move(POSE, CANVAS, 0.0)
    draw(client, 1.0)
    assert draw(client, 2.0) is None
    assert draw(client, 2.0, model=1).is_still


def test_the_own_camera_does_not_count_behind_the_input_camera():
    client = session()
    client.mode = "input camera"
    client.move(POSE, CANVAS, 0.0)
    assert draw(client, 1.0).wish.pose is None
    client.move(ELSEWHERE, CANVAS, 2.0)
    assert draw(client, 2.0) is None
    client.move(ELSEWHERE, (600, 900), 3.0)
    assert draw(client, 3.5).wish.size == (600, 900)


def test_nothing_is_drawn_while_it_is_held():
    client = session()
    client.move(POSE, CANVAS, 0.0)
    client.is_held = True
    assert draw(client, 1.0) is None


def test_a_view_that_is_let_go_comes_back_in_small_images_and_ends_in_a_full_one():
    client = session()
    client.mode = "input camera"
    client.move(POSE, CANVAS, 0.0)
    assert draw(client, 1.0).is_still
    client.elastic.pull((60.0, 0.0), 5.0, 2.0)
    client.change(2.0)
    held = draw(client, 2.0)
    assert 5 < held.wish.turn[0] < 6.25
    assert client.is_restless(2.2)
    jobs = [job for k in range(2, 300) if (job := draw(client, 2 + k / 100, 0.0)) is not None]
    turns = [job.wish.turn[0] for job in jobs]
    assert len(turns) > 5
    assert turns == sorted(turns, reverse=True)
    assert turns[-1] == 5.0
    assert [job.is_still for job in jobs] == [False] * (len(jobs) - 1) + [True]
    assert jobs[-1].wish.size == CANVAS
    assert not client.is_restless(9.0)
    client.mode = "orbit"
    client.change(9.0)
    assert draw(client, 9.0).wish.turn == (0, 0)
