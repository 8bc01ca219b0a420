"""Camera paths of random worlds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.scenes.synthetic.worlds.parts import UP, Mover

CameraKind = Literal["arc", "walking", "shaking", "following", "still"]

CAMERAS: tuple[CameraKind, ...] = ("arc", "walking", "shaking", "following", "still")

Views = tuple[np.ndarray, np.ndarray]
"""Centres [T, 3], and rotations [T, 3, 3] from the world to the cameras."""


@dataclass(frozen=True)
class Stand:
    """Where a camera is in the middle of the clip: ``place`` [3], the point it looks at [3], and its roll in radians."""

    place: np.ndarray
    target: np.ndarray
    roll: float


def look(places: np.ndarray, targets: np.ndarray, roll: np.ndarray | float, turns: np.ndarray | None = None) -> Views:
    """Cameras [T] that look at points [T, 3]; ``turns`` [T, 3] are small rotations of the camera in its own axes, in radians."""
    forward = targets - places
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    R = np.stack([right, np.cross(forward, right), forward], 1)
    own = np.zeros_like(places) if turns is None else turns.copy()
    own[:, 2] += roll
    return places, np.asarray(Rotation.from_rotvec(own).as_matrix()) @ R


def waves(rng: np.random.Generator, low: float, high: float, count: int = 4) -> Callable[[np.ndarray], np.ndarray]:
    """Smooth random motion [T, 3] with frequencies between ``low`` and ``high`` hertz and a standard deviation of 1."""
    rates = 2 * np.pi * np.exp(rng.uniform(np.log(low), np.log(high), (count, 3)))
    phases = rng.uniform(0, 2 * np.pi, (count, 3))
    weights = 1 / rates
    weights = weights * np.sqrt(2 / (weights**2).sum(0))
    return lambda times: np.asarray((weights * np.sin(rates * times[:, None, None] + phases)).sum(1))


@dataclass(frozen=True)
class _Setting:
    """What a path is drawn for.

    Attributes:
        stand: where the camera is in the middle of the clip.
        ahead: [3] horizontal unit vector towards what it looks at; ``right`` [3]: to the right of that.
        distance: metres to what is nearest of what matters.
        duration: of the clip, seconds.
        leader: the mover that ``following`` follows.
        jitter: smooth random motion [T, 3] of a hand that holds it; ``tremble``: of its angles.
        sign: -1 or 1: the way round of an arc.
    """

    stand: Stand
    ahead: np.ndarray
    right: np.ndarray
    distance: float
    duration: float
    leader: Mover
    jitter: Callable[[np.ndarray], np.ndarray]
    tremble: Callable[[np.ndarray], np.ndarray]
    sign: float

    def since_middle(self, times: np.ndarray) -> np.ndarray:
        """[T, 1] seconds since the middle of the clip."""
        return (times - self.duration / 2)[:, None]


def draw_path(
    rng: np.random.Generator, kind: CameraKind, stand: Stand, distance: float, duration: float, leader: Mover
) -> Callable[[np.ndarray], Views]:
    """A random path of a kind.

    Args:
        distance: metres to what is nearest of what matters.
        leader: the mover that ``following`` follows.
    """
    ahead = stand.target - stand.place
    ahead = ahead * [1, 1, 0] / np.linalg.norm(ahead[:2])
    jitter, tremble = waves(rng, 1.0, 5.0), waves(rng, 1.0, 6.0)
    sign = rng.choice([-1.0, 1.0])
    setting = _Setting(stand, ahead, np.cross(ahead, UP), distance, duration, leader, jitter, tremble, sign)
    return _PATHS[kind](rng, setting)


def _arc(rng: np.random.Generator, s: _Setting) -> Callable[[np.ndarray], Views]:
    """About a point ahead."""
    middle, target = s.stand.place, s.stand.target
    sweep, rises = s.sign * np.radians(rng.uniform(8, 28)), rng.uniform(-0.08, 0.08) * s.distance
    reach = np.linalg.norm((target - middle)[:2])
    # Not about the target but a point nearer, so that far targets do not make it run.
    pivot = middle + min(reach, 8.0) * s.ahead

    def arc(times: np.ndarray) -> Views:
        w = times / s.duration - 0.5
        turned = np.asarray(Rotation.from_rotvec(UP * (sweep * w)[:, None]).apply(middle - pivot))
        return look(pivot + turned + rises * w[:, None] * UP, np.broadcast_to(target, turned.shape), s.stand.roll)

    return arc


def _walking(rng: np.random.Generator, s: _Setting) -> Callable[[np.ndarray], Views]:
    """Straight on, in steps."""
    speed = rng.uniform(0.6, 1.4)
    # Not more than a quarter of the way to what is nearest.
    angle = rng.uniform(0, 2 * np.pi)
    towards = np.cos(angle) * s.ahead + np.sin(angle) * s.right
    speed = min(speed, 0.25 * s.distance / s.duration / max(abs(np.cos(angle)), 0.2))
    bob, sway, phase = rng.uniform(0.015, 0.035), rng.uniform(0.01, 0.025), rng.uniform(0, 2 * np.pi)
    rate = 2 * np.pi * rng.uniform(1.7, 2.1)
    gaze = rng.uniform(0, 0.8)

    def walking(times: np.ndarray) -> Views:
        went = (speed * (times - s.duration / 2))[:, None] * towards
        places = s.stand.place + went + (bob * np.sin(rate * times + phase))[:, None] * UP
        places = places + (sway * np.sin(0.5 * rate * times + phase))[:, None] * s.right
        turns = np.radians(0.25) * s.tremble(times)
        turns[:, 2] += np.radians(0.5) * np.sin(0.5 * rate * times + phase)
        return look(places, s.stand.target + gaze * went, s.stand.roll, turns)

    return walking


def _shaking(rng: np.random.Generator, s: _Setting) -> Callable[[np.ndarray], Views]:
    """Held by hand, hardly moving on."""
    drift = rng.uniform(0, 0.12) * (np.cos(a := rng.uniform(0, 2 * np.pi)) * s.ahead + np.sin(a) * s.right)
    strong, shift = np.radians(rng.uniform(0.25, 0.9)), rng.uniform(0.008, 0.03)

    def shaking(times: np.ndarray) -> Views:
        places = s.stand.place + s.since_middle(times) * drift + shift * s.jitter(times)
        return look(places, np.broadcast_to(s.stand.target, places.shape), s.stand.roll, strong * s.tremble(times))

    return shaking


def _following(rng: np.random.Generator, s: _Setting) -> Callable[[np.ndarray], Views]:
    """Beside a mover."""
    share = rng.uniform(0.4, 1.0)
    # What swings or flaps is followed only as far as it travels.
    ends = s.leader.centre(np.array([0.0, s.duration]))
    travel = (ends[1] - ends[0]) * [1, 1, 0] / s.duration

    def following(times: np.ndarray) -> Views:
        went = s.since_middle(times) * travel
        places = s.stand.place + share * went + 0.006 * s.jitter(times)
        return look(places, s.stand.target + 0.9 * went, s.stand.roll, np.radians(0.15) * s.tremble(times))

    return following


def _still(rng: np.random.Generator, s: _Setting) -> Callable[[np.ndarray], Views]:
    """On a tripod."""

    def fixed(times: np.ndarray) -> Views:
        ones = np.ones((len(times), 1))
        return look(s.stand.place * ones, s.stand.target * ones, s.stand.roll)

    return fixed


_PATHS: dict[CameraKind, Callable[[np.random.Generator, _Setting], Callable[[np.ndarray], Views]]] = {
    "arc": _arc, "walking": _walking, "shaking": _shaking, "following": _following, "still": _still,
}  # fmt: skip
