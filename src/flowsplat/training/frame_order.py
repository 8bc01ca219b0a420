"""In which order training frames are drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

GOLDEN_RATIO = (5**0.5 - 1) / 2
"""Its multiples, without what is whole of them, are spread most evenly (Knuth, The Art of Computer Programming 3, 6.4)."""

Order = Literal["random", "spread"]


class FrameOrder:
    """Draws frames in rounds: in each of them every frame comes as often as it is to be visited."""

    def __init__(self, count: int, order: Order, seed: int, visits: Sequence[int] | None = None):
        """``count``: of frames; ``order``: as ``TrainConfig.order``; ``visits``: how often each comes in a round, None = once."""
        self._round = np.repeat(np.arange(count), 1 if visits is None else visits)
        self._count, self._order = count, order
        self._rng = np.random.default_rng(seed)
        self._queue: list[int] = []

    def take(self, count: int) -> list[int]:
        """Return the frames of a step."""
        chosen = []
        for _ in range(count):
            if not self._queue:
                size = len(self._round)
                order = spread_order(size, self._rng) if self._order == "spread" else self._rng.permutation(size)
                self._queue = self._round[order].tolist()
            chosen.append(self._queue.pop())
        return chosen

    @property
    def following(self) -> list[int]:
        """The frame that comes next, if this round has one left."""
        return self._queue[-1:]

    def values(self) -> dict[str, Any]:
        """Return where it is, for a checkpoint."""
        return {"queue": self._queue, "rng": self._rng.bit_generator.state}

    def restore(self, values: Mapping[str, Any]) -> None:
        """The inverse of ``values``.

        Raises:
            ValueError: it names frames that are not there, or its generator is none.
        """
        queue = list(values["queue"])
        if any(k >= self._count for k in queue):
            raise ValueError("it names frames that are not there")
        self._rng.bit_generator.state = values["rng"]
        self._queue = queue


def spread_order(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return a permutation [count] of which any few in a row lie far apart: multiples of the golden ratio, from a random one on."""
    return np.argsort(np.argsort((rng.random() + GOLDEN_RATIO * np.arange(count)) % 1))
