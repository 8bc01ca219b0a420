"""Animals on four legs, whose feet are planted without slip: a dog, a sheep or a calf, by their size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowsplat.scenes.synthetic.worlds.ground import WorldGround
from flowsplat.scenes.synthetic.worlds.materials import draw_material
from flowsplat.scenes.synthetic.worlds.parts import UP, Poses, WorldObject, about, ball, capsule, ellipsoid, frame, rod, together
from flowsplat.scenes.synthetic.worlds.people import HALF_FOOT, SHIN, THIGH, Gait, find_hips, find_knee, place_ankle

SHOULDER_HEIGHT = 0.55
"""Meters from the ground to the back of an animal of scale 1, a large dog. Chosen by eye."""

_LEG_SCALE = 0.42
"""Scale of the legs, of those of a person: thigh, shin and foot are .39 m together. Chosen by eye."""
_BODY_LENGTH = 0.62
"""Meters between the front and the hind legs of scale 1. Chosen by eye."""


def animal(
    rng: np.random.Generator, ground: WorldGround, at: np.ndarray, heading: float, scale: float, speed: float, duration: float,
    rich: bool,
) -> WorldObject:  # fmt: skip
    """Return an animal that walks straight, in the middle of the clip at ``at`` [2]; the arguments as of ``people.walker``."""
    legs = _LEG_SCALE * scale
    step = legs * np.clip(0.3 + 0.24 * speed / legs, 0.3, 0.66)
    ahead = np.array([np.cos(heading), np.sin(heading)])
    front = Gait(ground, at + 0.5 * _BODY_LENGTH * scale * ahead, heading, 0.0, step, rng.uniform(0, 2 * step), legs)
    # The hind legs walk as the front ones do, a quarter of a step later, as a walking dog's.
    hind = replace(front, at=at - 0.5 * _BODY_LENGTH * scale * ahead, first=front.first + 0.5 * step)
    hips = [find_hips(gait, speed, duration) for gait in (front, hind)]
    coat, other = draw_material(rng, 0.5 * scale, rich), draw_material(rng, 0.3 * scale, False)
    limb = [capsule(0.035 * scale, THIGH * legs, coat), capsule(0.026 * scale, SHIN * legs, other)]
    limb.append(ellipsoid(HALF_FOOT * legs, other))
    parts = [
        ellipsoid(np.array([0.45, 0.13, 0.15]) * scale, coat), ellipsoid(np.array([0.15, 0.07, 0.08]) * scale, coat),
        ball(0.085 * scale, other), capsule(0.025 * scale, 0.25 * scale, coat), *limb * 4,
    ]  # fmt: skip

    def poses(times: np.ndarray) -> Poses:
        s = speed * (times - duration / 2)
        joints, found = [], []
        for gait, height in zip((front, hind), hips, strict=True):
            place, yaw = gait.place(s)
            level = frame(np.stack([np.cos(yaw), np.sin(yaw), 0 * s], -1), UP)
            joint = np.concatenate([place, height(times)[:, None]], 1)
            joints.append(joint)
            for side in (-1, 1):
                hip = joint - side * 0.1 * legs * level[..., 1]
                ankle, turn, middle = place_ankle(gait, s, side)
                knee = find_knee(hip, ankle, level[..., 0], THIGH * legs, SHIN * legs)
                found += [rod(hip, knee, level[..., 0]), rod(knee, ankle, level[..., 0]), (turn, middle)]
        way = joints[0] - joints[1]
        trunk = frame(way, UP)

        def point(x: float, z: float) -> np.ndarray:
            return np.asarray(0.5 * (joints[0] + joints[1]) + trunk @ (scale * np.array([x, 0, z])))

        nod = trunk @ about(np.array([0.0, 1.0, 0.0]), np.full(len(s), 0.3))
        return together([
            (trunk, point(0, 0.08)), (nod, point(0.5, 0.26)), (trunk, point(0.42, 0.3)),
            rod(point(-0.42, 0.13), point(-0.55, 0.3), trunk[..., 1]), *found,
        ])  # fmt: skip

    def touching(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = speed * (times - duration / 2)
        feet = [gait.foot(s, side) for gait in (front, hind) for side in (-1, 1)]
        return np.stack([foot[0] for foot in feet], 1), np.stack([foot[3] for foot in feet], 1)

    return WorldObject("animal", tuple(parts), poses, touching)
