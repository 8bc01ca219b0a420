"""When checkpoints are due."""

from __future__ import annotations

from flowsplat.training.timing import CheckpointTimes


def test_by_time_the_first_comes_soon_and_costly_ones_come_rarely():
    times = CheckpointTimes(None, 100.0)
    assert not times.is_due(250, 104.9)
    assert times.is_due(1, 105.0)
    times.note_written(105.0, 0.1)
    assert not times.is_due(2, 124.9)
    assert times.is_due(3, 125.0)
    times.note_written(126.0, 1.0)
    assert not times.is_due(4, 175.9)
    assert times.is_due(4, 176.0)


def test_a_given_number_of_steps_wins():
    times = CheckpointTimes(10, 0.0)
    assert [step for step in range(1, 31) if times.is_due(step, 1000.0)] == [10, 20, 30]
    assert not any(CheckpointTimes(0, 0.0).is_due(step, 1000.0) for step in range(1, 300))
