"""Check what may stand where: objects that meet nothing, and a camera that is inside of nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowsplat.scenes.synthetic.worlds.parts import Placed, WorldObject
from flowsplat.scenes.synthetic.worlds.world import World


def balls(obj: WorldObject, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (centers [T, P, 3], radii [P]) of balls round the parts."""
    return obj.poses(times)[1], np.array([part.radius for part in obj.parts])


def reach(obj: WorldObject, times: np.ndarray) -> float:
    """Meters from an object's center to its furthest end."""
    centers, radii = balls(obj, times)
    return float((np.linalg.norm(centers - obj.center(times)[:, None], axis=-1) + radii).max())


def apart(placed: Placed, obj: WorldObject, times: np.ndarray) -> bool:
    """Return whether something static is nowhere near the way of an object."""
    centers, radii = balls(obj, times)
    local = np.abs((centers - placed.center) @ placed.turn)
    gap = np.linalg.norm(np.maximum(local - placed.part.size, 0), axis=-1)
    return bool((gap > radii + 0.05).all())


def are_apart(objects: Sequence[WorldObject], times: np.ndarray, first_two_touch: bool) -> bool:
    """Return whether no object meets another one, or what holds another one; the first two may, if they touch on purpose."""
    found = [balls(obj, times) for obj in objects]
    for a in range(len(found)):
        for b in range(a + 1, len(found)):
            if (a, b) == (0, 1) and first_two_touch:
                continue
            away = np.linalg.norm(found[a][0][:, :, None] - found[b][0][:, None], axis=-1)
            if (away < found[a][1][:, None] + found[b][1]).any():
                return False
    for a, obj in enumerate(objects):
        for b, other in enumerate(objects):
            if a != b and not all(apart(placed, other, times) for placed in obj.support):
                return False
    return True


def is_free(world: World, centers: np.ndarray) -> bool:
    """Return whether a camera at ``centers`` [T, 3], at times spread over the world's, is inside or next to nothing."""
    for placed in world.static[1:]:
        local = np.abs((centers - placed.center) @ placed.turn)
        if (np.linalg.norm(np.maximum(local - placed.part.size, 0), axis=-1) < 0.3).any():
            return False
    times = np.linspace(0, world.duration, len(centers))
    for obj in world.objects:
        places, radii = balls(obj, times)
        if (np.linalg.norm(places - centers[:, None], axis=-1) < radii + 0.5).any():
            return False
    return True
