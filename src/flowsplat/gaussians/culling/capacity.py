"""Bound the rows that are computed where the number of active Gaussians is not known yet."""

from __future__ import annotations

from collections.abc import Sequence

GRANULE = 1024
"""Gaussians: capacities are multiples of this, so that buffers change rarely. Chosen by eye."""


class RowCapacity:
    """How many rows a frame has: first those for Gaussians at rest, then those for moving ones. It only grows.

    What a device computes next must have a size before the host knows how many Gaussians are active, or the host waits.

    Attributes:
        at_rest: rows for Gaussians at rest.
        moving: rows for moving ones.
    """

    def __init__(self) -> None:
        self.at_rest = self.moving = GRANULE

    def fits(self, needed: Sequence[int]) -> bool:
        """Return whether there are rows for so many, at rest and moving."""
        return needed[0] <= self.at_rest and needed[1] <= self.moving

    def grow(self, needed: Sequence[int]) -> None:
        """Where there are too few rows for so many, at rest and moving: as many as are needed, and a quarter more."""
        self.at_rest, self.moving = _grow(self.at_rest, needed[0]), _grow(self.moving, needed[1])


def _grow(capacity: int, needed: int) -> int:
    """In steps that are not too fine."""
    return capacity if needed <= capacity else -(-(needed + needed // 4) // GRANULE) * GRANULE
