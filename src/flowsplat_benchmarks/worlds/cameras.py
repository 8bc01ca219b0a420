"""Random camera paths."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.scenes.synthetic.worlds.cameras import CameraKind, Views, look, waves
from flowsplat.scenes.synthetic.worlds.parts import UP, WorldObject

CAMERAS: tuple[CameraKind, ...] = ("arc", "walking", "shaking", "following", "still")


@dataclass(frozen=True)
class Stand:
    """Where a camera is in the middle of the clip: ``place`` [3], the point it looks at [3], and its roll in radians."""

    place: np.ndarray
    target: np.ndarray
    roll: float


Path = Callable[[np.ndarray], Views]
"""From times [T] in seconds to the cameras."""


@dataclass(frozen=True)
class _Around:
    """A camera's surroundings: where it stands, unit vectors [3] ahead and to the right on the ground, and seconds of the clip."""

    stand: Stand
    ahead: np.ndarray
    right: np.ndarray
    duration: float


def draw_path(
    rng: np.random.Generator, kind: CameraKind, stand: Stand, distance: float, duration: float, leader: WorldObject
) -> Path:
    """A random path of a kind.

    Args:
        distance: meters to what is nearest of what matters.
        leader: the object that ``following`` follows.
    """
    ahead = stand.target - stand.place
    ahead = ahead * [1, 1, 0] / np.linalg.norm(ahead[:2])
    around = _Around(stand, ahead, np.cross(ahead, UP), duration)
    jitter, tremble = waves(rng, 1.0, 5.0), waves(rng, 1.0, 6.0)
    sign = rng.choice([-1.0, 1.0])
    if kind == "arc":
        return _arc(rng, around, distance, sign)
    if kind == "walking":
        return _draw_walking(rng, around, distance, tremble)
    if kind == "shaking":
        return _draw_shaking(rng, around, jitter, tremble)
    if kind == "following":
        return _draw_following(rng, around, leader, jitter, tremble)
    return _still(around)


def _arc(rng: np.random.Generator, around: _Around, distance: float, sign: float) -> Path:
    """About a point before the camera, a little up or down on the way."""
    middle, target = around.stand.place, around.stand.target
    sweep, rises = sign * np.radians(rng.uniform(8, 28)), rng.uniform(-0.08, 0.08) * distance
    reach = np.linalg.norm((target - middle)[:2])
    # Not about the target but a point nearer, so that far targets do not make it run.
    pivot = middle + min(reach, 8.0) * around.ahead

    def arc(times: np.ndarray) -> Views:
        w = times / around.duration - 0.5
        turned = np.asarray(Rotation.from_rotvec(UP * (sweep * w)[:, None]).apply(middle - pivot))
        return look(pivot + turned + rises * w[:, None] * UP, np.broadcast_to(target, turned.shape), around.stand.roll)

    return arc


def _draw_walking(rng: np.random.Generator, around: _Around, distance: float, tremble: Callable[[np.ndarray], np.ndarray]) -> Path:
    """In some direction at the pace of a person, whose steps it shows."""
    middle, target, duration = around.stand.place, around.stand.target, around.duration
    speed = rng.uniform(0.6, 1.4)
    # Not more than a quarter of the way to what is nearest.
    angle = rng.uniform(0, 2 * np.pi)
    towards = np.cos(angle) * around.ahead + np.sin(angle) * around.right
    speed = min(speed, 0.25 * distance / duration / max(abs(np.cos(angle)), 0.2))
    bob, sway, phase = rng.uniform(0.015, 0.035), rng.uniform(0.01, 0.025), rng.uniform(0, 2 * np.pi)
    rate = 2 * np.pi * rng.uniform(1.7, 2.1)
    gaze = rng.uniform(0, 0.8)

    def walking(times: np.ndarray) -> Views:
        went = (speed * (times - duration / 2))[:, None] * towards
        places = middle + went + (bob * np.sin(rate * times + phase))[:, None] * UP
        places = places + (sway * np.sin(0.5 * rate * times + phase))[:, None] * around.right
        turns = np.radians(0.25) * tremble(times)
        turns[:, 2] += np.radians(0.5) * np.sin(0.5 * rate * times + phase)
        return look(places, target + gaze * went, around.stand.roll, turns)

    return walking


def _draw_shaking(
    rng: np.random.Generator, around: _Around, jitter: Callable[[np.ndarray], np.ndarray],
    tremble: Callable[[np.ndarray], np.ndarray],
) -> Path:  # fmt: skip
    """In a hand, at one place or drifting slowly."""
    middle, target = around.stand.place, around.stand.target
    drift = rng.uniform(0, 0.12) * (np.cos(a := rng.uniform(0, 2 * np.pi)) * around.ahead + np.sin(a) * around.right)
    strong, shift = np.radians(rng.uniform(0.25, 0.9)), rng.uniform(0.008, 0.03)

    def shaking(times: np.ndarray) -> Views:
        places = middle + (times - around.duration / 2)[:, None] * drift + shift * jitter(times)
        return look(places, np.broadcast_to(target, places.shape), around.stand.roll, strong * tremble(times))

    return shaking


def _draw_following(
    rng: np.random.Generator, around: _Around, leader: WorldObject, jitter: Callable[[np.ndarray], np.ndarray],
    tremble: Callable[[np.ndarray], np.ndarray],
) -> Path:  # fmt: skip
    """Beside an object, at a share of its speed."""
    middle, target, duration = around.stand.place, around.stand.target, around.duration
    share = rng.uniform(0.4, 1.0)
    # What swings or flaps is followed only as far as it travels.
    ends = leader.center(np.array([0.0, duration]))
    travel = (ends[1] - ends[0]) * [1, 1, 0] / duration

    def following(times: np.ndarray) -> Views:
        went = (times - duration / 2)[:, None] * travel
        places = middle + share * went + 0.006 * jitter(times)
        return look(places, target + 0.9 * went, around.stand.roll, np.radians(0.15) * tremble(times))

    return following


def _still(around: _Around) -> Path:
    """On a tripod."""

    def still(times: np.ndarray) -> Views:
        ones = np.ones((len(times), 1))
        return look(around.stand.place * ones, around.stand.target * ones, around.stand.roll)

    return still
