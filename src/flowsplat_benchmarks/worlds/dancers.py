"""Dancers: people who turn on the spot and swing their limbs as fast as people do, some with a stick in one hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowsplat.scenes.synthetic.worlds.cameras import waves
from flowsplat.scenes.synthetic.worlds.ground import WorldGround
from flowsplat.scenes.synthetic.worlds.materials import draw_material
from flowsplat.scenes.synthetic.worlds.parts import UP, Poses, WorldObject, WorldPart, about, capsule, frame, rod, together
from flowsplat.scenes.synthetic.worlds.people import (
    ANKLE,
    HALF_FOOT,
    HIP,
    LOWER_ARM,
    SHIN,
    SHOULDER,
    SHOULDER_HEIGHT,
    THIGH,
    UPPER_ARM,
    body,
)

STICK_SHARE = 0.5
"""Share of dancers with a stick. Chosen by eye."""

_ACROSS = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Swing:
    """An angle over time: ``middle`` + ``reach`` sin(2 pi ``rate`` t + ``phase``), radians and hertz."""

    middle: float
    reach: float
    rate: float
    phase: float

    def __call__(self, times: np.ndarray) -> np.ndarray:
        return np.asarray(self.middle + self.reach * np.sin(2 * np.pi * self.rate * times + self.phase))


@dataclass(frozen=True)
class Limb:
    """How an arm or a leg swings: how far it is raised, to which side (0 = forward, pi / 2 = outward), how far it is bent."""

    raised: Swing
    aside: Swing
    bent: Swing


def dancer(rng: np.random.Generator, ground: WorldGround, at: np.ndarray, heading: float, scale: float, rich: bool) -> WorldObject:
    """Return a person who dances about a place ``at`` [2]; ``heading``, ``scale`` and ``rich`` as of a walker."""
    parts = body(rng, scale, rich)
    turn = Swing(heading, rng.uniform(0.2, 1.2), rng.uniform(0.3, 0.9), rng.uniform(0, 2 * np.pi))
    spin = float(rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 7.0)) if rng.random() < 0.5 else 0.0
    sway, bow = waves(rng, 0.3, 1.0), Swing(0.08, rng.uniform(0, 0.25), rng.uniform(0.4, 1.2), rng.uniform(0, 2 * np.pi))
    arms = [_limb(rng, (0.5, 1.7), (0.4, 1.2), (0.8, 2.2)) for _ in range(2)]
    legs = [_limb(rng, (0.0, 0.3), (0.3, 0.8), (0.6, 1.6)) for _ in range(2)]
    stick = rng.random() < STICK_SHARE
    if stick:
        parts.append(capsule(rng.uniform(0.012, 0.03) * scale, rng.uniform(0.5, 1.1) * scale, draw_material(rng, 0.2, rich)))

    def found(times: np.ndarray) -> tuple[list[Poses], np.ndarray, np.ndarray]:
        place = at + 0.08 * scale * sway(times)[:, :2]
        yaw = turn(times) + spin * times
        return _pose(ground, place, yaw, bow(times), arms, legs, scale, parts[-1] if stick else None, times)

    def touching(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        _, soles, above = found(times)
        return soles, above <= above.min(1, keepdims=True)

    return WorldObject("dancer", tuple(parts), lambda times: together(found(times)[0]), touching)


def _limb(rng: np.random.Generator, middle: tuple[float, float], reach: tuple[float, float], rate: tuple[float, float]) -> Limb:
    pace = rng.uniform(*rate)

    def swing(middle: float, reach: float) -> Swing:
        return Swing(middle, reach, pace, rng.uniform(0, 2 * np.pi))

    bend = rng.uniform(0.2, 0.6)
    return Limb(
        swing(rng.uniform(*middle), rng.uniform(*reach)), swing(rng.uniform(0.2, 1.2), rng.uniform(0, 0.8)),
        swing(bend, rng.uniform(0.3, 1.0) * bend),
    )  # fmt: skip


def _pose(
    ground: WorldGround, place: np.ndarray, yaw: np.ndarray, bow: np.ndarray, arms: list[Limb], legs: list[Limb], scale: float,
    stick: WorldPart | None, times: np.ndarray,
) -> tuple[list[Poses], np.ndarray, np.ndarray]:  # fmt: skip
    """Return (poses of all parts, soles [T, 2, 3], their heights above the ground [T, 2]): the lower sole stands on it."""
    level = frame(np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], -1), UP)
    lean = level @ about(_ACROSS, bow)
    hip = np.concatenate([place, np.zeros((len(place), 1))], 1)

    def point(x: float, y: float, z: float) -> np.ndarray:
        return np.asarray(hip + lean @ (scale * np.array([x, y, z])))

    def way(limb: Limb, side: int, bend: float) -> np.ndarray:
        """Return [T, 3] direction of the upper (``bend`` 0) or lower part of a limb."""
        up, out = limb.raised(times) + bend * limb.bent(times), limb.aside(times)
        flat = np.cos(out)[:, None] * level[..., 0] - side * np.sin(out)[:, None] * level[..., 1]
        return np.asarray(np.sin(up)[:, None] * flat - np.cos(up)[:, None] * UP)

    found: list[Poses] = [
        (level, point(0, 0, 0.02)), (lean, point(0.02, 0, 0.28)), rod(point(0.035, 0, 0.54), point(0.045, 0, 0.66), lean[..., 1]),
        (lean, point(0.06, 0, 0.75)), (lean, point(0.045, 0, 0.79)),
    ]  # fmt: skip
    soles = []
    for side, limb in zip((-1, 1), legs, strict=True):
        joint = point(0, -side * HIP, 0)
        knee = joint + THIGH * scale * way(limb, side, 0)
        ankle = knee + SHIN * scale * way(limb, side, -1)  # Knees bend backwards.
        foot = rod(knee, ankle, level[..., 0])[0]
        sole = ankle + scale * (foot @ np.array([0.3 * HALF_FOOT[0], 0, ANKLE]))
        found += [rod(joint, knee, level[..., 0]), rod(knee, ankle, level[..., 0])]
        found.append((foot, sole - HALF_FOOT[2] * scale * foot[..., 2]))
        soles.append(sole)
    for side, limb in zip((-1, 1), arms, strict=True):
        shoulder = point(0.03, -side * SHOULDER, SHOULDER_HEIGHT)
        elbow = shoulder + UPPER_ARM * scale * way(limb, side, 0)
        hand = elbow + LOWER_ARM * scale * way(limb, side, 1)
        found += [rod(shoulder, elbow, level[..., 0]), rod(elbow, hand, level[..., 0])]
    if stick is not None:
        held = found[-1][0]
        along = (held[..., 0] + held[..., 2]) / np.sqrt(2)
        end = hand + 1.8 * stick.size[2] * along
        found.append(rod(end - 2 * stick.size[2] * along, end, held[..., 1]))
    standing = np.stack(soles, 1)
    above = standing[..., 2] - ground.height(standing[..., :2])
    lift = -above.min(1)
    raised = [(R, c + lift[:, None] * UP) for R, c in found]
    return raised, standing + lift[:, None, None] * UP, above
