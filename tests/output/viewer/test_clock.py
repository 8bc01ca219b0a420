"""Time as a client sees it."""

from __future__ import annotations

import pytest

from flowsplat.output.viewer.clock import PlaybackClock


def test_it_plays_at_its_speed_and_loops():
    clock = PlaybackClock(1.0, 3.0)
    assert clock.at(50.0) == 1.0
    clock.play(True, 50.0)
    assert clock.at(50.5) == 1.5
    clock.set_speed(0.5, 51.0)
    assert clock.at(52.0) == pytest.approx(2.5)
    assert clock.at(54.0) == pytest.approx(1.5), "round and round"
    assert clock.playing


def test_it_stops_where_it_is_told_to():
    clock = PlaybackClock(0.0, 2.0)
    clock.play(True, 10.0)
    clock.play(False, 11.0)
    assert clock.at(99.0) == 1.0


def test_without_a_loop_it_stops_at_the_end_and_begins_again():
    clock = PlaybackClock(0.0, 2.0)
    clock.loop = False
    clock.play(True, 10.0)
    assert clock.at(13.0) == 2.0
    assert not clock.playing
    clock.play(True, 20.0)
    assert clock.at(20.5) == 0.5


def test_it_goes_on_from_where_it_is_set():
    clock = PlaybackClock(0.0, 2.0)
    clock.play(True, 0.0)
    clock.set(1.5, 1.0)
    assert clock.at(1.25) == 1.75
    clock.set(9.0, 2.0)
    assert clock.at(2.0) == 2.0
