"""What may stand where: movers that meet nothing, and a camera that is inside of nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowsplat.scenes.synthetic.worlds.parts import Mover, Placed
from flowsplat.scenes.synthetic.worlds.world import World


def balls(mover: Mover, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(centers [T, P, 3], radii [P]) of balls round the parts."""
    return mover.poses(times)[1], np.array([part.radius for part in mover.parts])


def reach(mover: Mover, times: np.ndarray) -> float:
    """Meters from a mover's center to its furthest end."""
    centers, radii = balls(mover, times)
    return float((np.linalg.norm(centers - mover.center(times)[:, None], axis=-1) + radii).max())


def apart(placed: Placed, mover: Mover, times: np.ndarray) -> bool:
    """Whether something static is nowhere near the way of a mover."""
    centers, radii = balls(mover, times)
    local = np.abs((centers - placed.center) @ placed.turn)
    gap = np.linalg.norm(np.maximum(local - placed.part.size, 0), axis=-1)
    return bool((gap > radii + 0.05).all())


def are_apart(movers: Sequence[Mover], times: np.ndarray, first_two_touch: bool) -> bool:
    """Whether no mover meets another one, or what holds another one; the first two may, if they touch on purpose."""
    found = [balls(mover, times) for mover in movers]
    for a in range(len(found)):
        for b in range(a + 1, len(found)):
            if (a, b) == (0, 1) and first_two_touch:
                continue
            away = np.linalg.norm(found[a][0][:, :, None] - found[b][0][:, None], axis=-1)
            if (away < found[a][1][:, None] + found[b][1]).any():
                return False
    for a, mover in enumerate(movers):
        for b, other in enumerate(movers):
            if a != b and not all(apart(placed, other, times) for placed in mover.support):
                return False
    return True


def is_free(world: World, centers: np.ndarray) -> bool:
    """Whether a camera at ``centers`` [T, 3], at times spread over the world's, is inside or next to nothing."""
    for placed in world.static[1:]:
        local = np.abs((centers - placed.center) @ placed.turn)
        if (np.linalg.norm(np.maximum(local - placed.part.size, 0), axis=-1) < 0.3).any():
            return False
    times = np.linspace(0, world.duration, len(centers))
    for mover in world.movers:
        places, radii = balls(mover, times)
        if (np.linalg.norm(places - centers[:, None], axis=-1) < radii + 0.5).any():
            return False
    return True
