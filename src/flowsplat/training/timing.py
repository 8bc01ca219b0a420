"""Decide when a training writes its checkpoints."""

from __future__ import annotations

FIRST_CHECKPOINT, CHECKPOINT_INTERVAL = 5.0, 20.0
"""Seconds until the first checkpoint, so that there is something to look at, and from one to the next. Chosen by eye."""
MAX_CHECKPOINT_SHARE = 0.02
"""Share of the time that checkpoints may take. Chosen by eye."""


class CheckpointTimes:
    """By steps where their number is given, else by time."""

    def __init__(self, every: int | None, now: float):
        """``every``: steps between two checkpoints, 0 = none, None = by time; ``now``: in seconds."""
        self._every, self._next = every, now + FIRST_CHECKPOINT

    def is_due(self, step: int, now: float) -> bool:
        """Return whether one is due after a step."""
        return now >= self._next if self._every is None else self._every > 0 and step % self._every == 0

    def note_written(self, now: float, seconds: float) -> None:
        """Note that one was written, and how long that took."""
        self._next = now + max(CHECKPOINT_INTERVAL, seconds / MAX_CHECKPOINT_SHARE)
