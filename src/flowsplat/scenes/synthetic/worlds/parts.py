"""Parts and objects of random worlds, and what all motions are made of. World z is up; meters, seconds, radians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from flowsplat.scenes.synthetic.worlds.casting import BOX, CAPSULE, CYLINDER, ELLIPSOID

Kind = Literal["walker", "carrier", "vehicle", "rolling", "thrown", "bouncing", "pendulum", "door", "flier", "dancer", "animal"]

KINDS: tuple[Kind, ...] = ("walker", "carrier", "vehicle", "rolling", "thrown", "bouncing", "pendulum", "door", "flier")
"""Those that are drawn; dancers and animals only where they are asked for."""

Poses = tuple[np.ndarray, np.ndarray]
"""Rotations [T, P, 3, 3] from the parts' axes to the world's, and centers [T, P, 3]."""

UP = np.array([0.0, 0.0, 1.0])
GRAVITY = 9.81
"""m/s^2."""


@dataclass(frozen=True)
class WorldPart:
    """A rigid part.

    Attributes:
        shape: one of ``casting``'s.
        size: [3] as ``casting`` tells, in meters.
        material: [M] (see ``materials``).
    """

    shape: int
    size: np.ndarray
    material: np.ndarray

    @property
    def radius(self) -> float:
        """Of a ball round its center that holds it."""
        if self.shape == ELLIPSOID:
            return float(max(self.size))
        if self.shape == CAPSULE:
            return float(self.size[0] + self.size[2])
        if self.shape == CYLINDER:
            return float(np.hypot(self.size[0], self.size[2]))
        return float(np.linalg.norm(self.size))


@dataclass(frozen=True)
class Placed:
    """A part of the static world: ``turn`` [3, 3] from its axes to the world's, ``center`` [3]."""

    part: WorldPart
    turn: np.ndarray
    center: np.ndarray


@dataclass(frozen=True)
class WorldObject:
    """What moves, with all that is known of it.

    Attributes:
        kind: what it is.
        parts: of what it consists.
        poses: from times [T] to where its parts are.
        touching: from times [T] to points [T, K, 3] that may touch the ground, and whether they do so [T, K].
        instants: seconds at which it touches the ground for no time at all (a ball that bounces).
        swings: whether a point of it, or of what it hangs on, is fixed.
        rolls: whether it rolls on the ground without slip.
        pivot: [3] a fixed point of its axis of rotation, if it swings.
        support: static parts that belong to it: posts and a beam.
    """

    kind: Kind
    parts: tuple[WorldPart, ...]
    poses: Callable[[np.ndarray], Poses]
    touching: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    instants: tuple[float, ...] = ()
    swings: bool = False
    rolls: bool = False
    pivot: np.ndarray | None = None
    support: tuple[Placed, ...] = ()

    def center(self, times: np.ndarray) -> np.ndarray:
        """Return [T, 3] mean of the centers of its parts, the larger ones counting more."""
        weights = np.array([part.radius for part in self.parts])
        return np.asarray(np.einsum("tpk,p->tk", self.poses(np.atleast_1d(times))[1], weights / weights.sum()))


def touch_nothing(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For what flies or hangs."""
    return np.zeros((len(times), 0, 3)), np.zeros((len(times), 0), bool)


# -- parts


def ball(radius: float, material: np.ndarray) -> WorldPart:
    """Return a ball."""
    return WorldPart(ELLIPSOID, np.full(3, float(radius)), material)


def ellipsoid(half: ArrayLike, material: np.ndarray) -> WorldPart:
    """Return an ellipsoid of half axes [3]."""
    return WorldPart(ELLIPSOID, np.array(half, float), material)


def box(half: ArrayLike, material: np.ndarray) -> WorldPart:
    """Return a box of half extents [3]."""
    return WorldPart(BOX, np.array(half, float), material)


def capsule(radius: float, length: float, material: np.ndarray) -> WorldPart:
    """Return a tube with round ends, ``length`` between their centers."""
    return WorldPart(CAPSULE, np.array([radius, radius, length / 2]), material)


def cylinder(radius: float, half: float, material: np.ndarray) -> WorldPart:
    """Return a cylinder along its z."""
    return WorldPart(CYLINDER, np.array([radius, radius, float(half)]), material)


# -- rotations


def about(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return [T, 3, 3] rotations about an axis [3] by angles [T]."""
    return np.asarray(Rotation.from_rotvec(np.atleast_1d(angles)[:, None] * np.asarray(axis, float)).as_matrix())


def frame(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return [T, 3, 3] axes (forward, left, up) as columns: forward is kept, up is made upright to it. Both [T, 3] or [3]."""
    forward, up = np.broadcast_arrays(np.atleast_2d(forward).astype(float), np.atleast_2d(up).astype(float))
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    left = np.cross(up, forward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([forward, left, np.cross(forward, left)], -1)


def rod(start: np.ndarray, end: np.ndarray, aside: np.ndarray) -> Poses:
    """Return (rotations [T, 3, 3], centers [T, 3]) of a capsule between two points [T, 3], its x as near to ``aside`` as may be."""
    z = end - start
    z = z / np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-9)
    aside = np.broadcast_to(aside, z.shape)
    x = aside - (aside * z).sum(1, keepdims=True) * z
    x = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
    return np.stack([x, np.cross(z, x), z], -1), (start + end) / 2


def together(poses: Sequence[Poses]) -> Poses:
    """Return the poses of single parts ([T, 3, 3] and [T, 3] each) as those of all."""
    return np.stack([R for R, _ in poses], 1), np.stack([c for _, c in poses], 1)
