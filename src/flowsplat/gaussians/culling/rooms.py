"""How many Gaussians there is room for where their number is not known yet."""

from __future__ import annotations

from collections.abc import Sequence

GRANULE = 1024


class Rooms:
    """Places for the rows of a frame: first those of Gaussians at rest, then those of moving ones. They only grow.

    What a device computes next must have a size before the host knows how many Gaussians are active, or the host waits.

    Attributes:
        at_rest: places for Gaussians at rest.
        moving: places for moving ones.
    """

    def __init__(self) -> None:
        self.at_rest = self.moving = GRANULE

    def hold(self, needed: Sequence[int]) -> bool:
        """Whether so many, at rest and moving, find room."""
        return needed[0] <= self.at_rest and needed[1] <= self.moving

    def grow(self, needed: Sequence[int]) -> None:
        """Where there was too little room for so many, at rest and moving: make it, and a quarter more."""
        self.at_rest, self.moving = _grown(self.at_rest, needed[0]), _grown(self.moving, needed[1])


def _grown(room: int, needed: int) -> int:
    """In steps that are not too fine."""
    return room if needed <= room else -(-(needed + needed // 4) // GRANULE) * GRANULE
