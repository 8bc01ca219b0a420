"""Walkers: jointed capsules whose feet are planted without slip, alone or with something in their arms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from flowsplat.scenes.synthetic.worlds.ground import WorldGround
from flowsplat.scenes.synthetic.worlds.materials import SEGMENTS, draw_material
from flowsplat.scenes.synthetic.worlds.parts import (
    UP,
    Poses,
    WorldObject,
    WorldPart,
    about,
    ball,
    box,
    capsule,
    ellipsoid,
    frame,
    rod,
    together,
)

WALKER_HEIGHT = 1.75
"""Meters of a walker of scale 1. Chosen by eye."""

THIGH, SHIN, ANKLE = 0.43, 0.43, 0.08
"""Meters of a walker of scale 1, and the height of the ankle over the ground. Chosen by eye."""
UPPER_ARM, LOWER_ARM = 0.29, 0.27
"""Meters of a walker of scale 1. Chosen by eye."""
HIP, SHOULDER = 0.1, 0.21
"""Half the widths of hips and shoulders. Chosen by eye."""
SHOULDER_HEIGHT = 0.5
"""Above the hips. Chosen by eye."""
HALF_FOOT = np.array([0.13, 0.047, 0.035])

STANCE_SHARE = 0.55
"""A foot stands from this share of a step before the hips pass it to this share after. Chosen by eye."""

MAX_LEG_STRETCH = 0.995
"""Share of a leg's length that is used at most. Chosen by eye."""

_HIP_RATE = 240.0
"""Times a second at which the height of the hips is found. Chosen by eye."""
_HIP_WINDOW = 41
"""Of these times, the window over which it is smoothed. Chosen by eye."""

Arms = Literal["swing", "forward"]
"""``forward``: held out, as one carries or pushes."""


@dataclass(frozen=True)
class Gait:
    """Where a walker is and puts the feet, by the way s in meters that the hips went since the middle of the clip.

    Attributes:
        ground: what it walks on.
        at: [2] where it is at s = 0.
        heading: radians, there.
        bend: radians by which it turns in a meter.
        step: meters from one foot to the other.
        first: s at which the hips pass over a left foot.
        scale: of the body.
    """

    ground: WorldGround
    at: np.ndarray
    heading: float
    bend: float
    step: float
    first: float
    scale: float

    def place(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (places [..., 2], headings [...])."""
        middle = self.heading + 0.5 * self.bend * s
        chord = s * np.sinc(0.5 * self.bend * s / np.pi)
        return self.at + chord[..., None] * np.stack([np.cos(middle), np.sin(middle)], -1), self.heading + self.bend * s

    def plant(self, number: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (points [T, 3] on the ground, headings [T]) of the planted feet of one side, -1 left and 1 right."""
        place, heading = self.place(self.first + (2 * number + (side > 0)) * self.step)
        right = np.stack([np.sin(heading), -np.cos(heading)], -1)
        place = self.ground.off_edges(place + side * HIP * self.scale * right)
        return np.concatenate([place, self.ground.height(place)[:, None]], 1), heading

    def foot(self, s: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return (middle of the sole [T, 3], heading [T], pitch [T], whether it stands [T])."""
        own = self.first + (side > 0) * self.step
        number = np.floor((s - own + STANCE_SHARE * self.step) / (2 * self.step))
        since = (s - own - 2 * self.step * number) / self.step - STANCE_SHARE
        w = np.clip(since / (2 - 2 * STANCE_SHARE), 0, 1)
        (start, heading), (end, later) = self.plant(number, side), self.plant(number + 1, side)
        smooth = w * w * (3 - 2 * w)
        sole = start + smooth[:, None] * (end - start)
        # Up to a higher step at first, down to a lower one at last, so that it clears the edge.
        rise = end[:, 2] - start[:, 2]
        part = np.clip(np.where(rise > 0, 2.5 * w, 2.5 * w - 1.5), 0, 1)
        sole[:, 2] = start[:, 2] + part * part * (3 - 2 * part) * rise + 0.09 * self.scale * np.sin(np.pi * w)
        pitch = 0.35 * np.sin(np.pi * w) ** 2
        return sole, heading + smooth * (later - heading), pitch, since <= 0


def find_knee(hip: np.ndarray, ankle: np.ndarray, forward: np.ndarray, upper: float, lower: float) -> np.ndarray:
    """Return [T, 3] where a joint is between two points, bent forward."""
    way = ankle - hip
    distance = np.linalg.norm(way, axis=1, keepdims=True)
    way = way / distance
    distance = np.minimum(distance, upper + lower)
    along = (distance**2 + upper**2 - lower**2) / (2 * distance)
    aside = forward - (forward * way).sum(1, keepdims=True) * way
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    return np.asarray(hip + along * way + np.sqrt(np.maximum(upper**2 - along**2, 0)) * aside)


def walker(
    rng: np.random.Generator, ground: WorldGround, at: np.ndarray, heading: float, scale: float, speed: float, duration: float,
    rich: bool, carries: bool = False, arms: Arms = "swing",
) -> WorldObject:  # fmt: skip
    """Return a person who walks, in the middle of the clip at ``at`` [2].

    Args:
        scale: 1 = as tall as ``WALKER_HEIGHT``.
        speed: meters a second.
        duration: seconds of the clip.
        rich: whether the clothes have patterns.
        carries: a box, a ball or a bag.
    """
    step = scale * np.clip(0.3 + 0.24 * speed / scale, 0.3, 0.66)
    bend = 0.0 if arms == "forward" and not carries else rng.uniform(-0.15, 0.15)
    gait = Gait(ground, at, heading, bend, step, rng.uniform(0, 2 * step), scale)
    hips = find_hips(gait, speed, duration)
    bag = bool(rng.random() < 0.4) and carries
    held: Arms = "forward" if carries and not bag else arms
    parts = body(rng, scale, rich)
    if carries:
        parts += _draw_carried_parts(rng, scale, bag)

    def poses(times: np.ndarray) -> Poses:
        s = speed * (times - duration / 2)
        return together(_stand(gait, s, hips(times), held, parts, bag if carries else None))

    def touching(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = speed * (times - duration / 2)
        feet = [gait.foot(s, side) for side in (-1, 1)]
        return np.stack([foot[0] for foot in feet], 1), np.stack([foot[3] for foot in feet], 1)

    return WorldObject("carrier" if carries else "walker", tuple(parts), poses, touching)


def find_hips(gait: Gait, speed: float, duration: float) -> Callable[[np.ndarray], np.ndarray]:
    """Height of the hips over time: as high as both legs reach, smoothed without ever getting higher."""
    times = np.arange(-_HIP_WINDOW / _HIP_RATE, duration + 2 * _HIP_WINDOW / _HIP_RATE, 1 / _HIP_RATE)
    s = speed * (times - duration / 2)
    place, heading = gait.place(s)
    right = np.stack([np.sin(heading), -np.cos(heading)], -1)
    reach = MAX_LEG_STRETCH * gait.scale * (THIGH + SHIN)
    top = np.full(len(times), np.inf)
    for side in (-1, 1):
        ankle = place_ankle(gait, s, side)[0]
        away = np.linalg.norm(ankle[:, :2] - place - side * HIP * gait.scale * right, axis=1)
        top = np.minimum(top, ankle[:, 2] + np.sqrt(np.maximum(reach**2 - away**2, 0)))
    height = uniform_filter1d(minimum_filter1d(top, _HIP_WINDOW), _HIP_WINDOW)
    return lambda asked: np.interp(asked, times, height)


def place_ankle(gait: Gait, s: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (ankle [T, 3], rotation of the foot [T, 3, 3], its center [T, 3])."""
    sole, heading, pitch, _ = gait.foot(s, side)
    level = frame(gait.ground.tangent(heading), gait.ground.normal)
    joint = np.array([-0.3 * HALF_FOOT[0], 0, 0]) * gait.scale
    turned = level @ about(np.array([0.0, 1.0, 0.0]), pitch)
    heel = sole + level @ joint  # The foot turns about the point of the sole below the ankle.
    middle = np.array([0.3 * HALF_FOOT[0], 0, HALF_FOOT[2]]) * gait.scale
    return heel + ANKLE * gait.scale * turned[..., 2], turned, heel + turned @ middle


def body(rng: np.random.Generator, scale: float, rich: bool) -> list[WorldPart]:
    """Return the parts of a person: hips, trunk, neck, head and hair, then thigh, shin and foot of both legs, then both arms."""
    shirt, trousers = draw_material(rng, 0.5 * scale, rich), draw_material(rng, 0.5 * scale, rich and bool(rng.random() < 0.5))
    shoe, sleeve = draw_material(rng, 0.3, False), shirt if rng.random() < 0.6 else draw_material(rng, 0.3, rich)
    skin = draw_material(rng, 0.3, False)
    skin[2:8] = np.tile(np.array([0.85, 0.62, 0.48]) * rng.uniform(0.4, 1.05), 2)
    hair = draw_material(rng, 0.1, False)
    hair[2:8] *= 0.4
    leg = [capsule(0.075 * scale, THIGH * scale, trousers), capsule(0.055 * scale, SHIN * scale, trousers)]
    leg.append(box(HALF_FOOT * scale, shoe))
    arm = [capsule(0.048 * scale, UPPER_ARM * scale, sleeve), capsule(0.04 * scale, LOWER_ARM * scale, skin)]
    trunk = [
        ellipsoid(np.array([0.12, 0.165, 0.13]) * scale, trousers), ellipsoid(np.array([0.135, 0.2, 0.32]) * scale, shirt),
        capsule(0.05 * scale, 0.12 * scale, skin), ellipsoid(np.array([0.1, 0.085, 0.12]) * scale, skin),
        ellipsoid(np.array([0.1, 0.092, 0.09]) * scale, hair),
    ]  # fmt: skip
    return [*trunk, *leg, *leg, *arm, *arm]


def _draw_carried_parts(rng: np.random.Generator, scale: float, bag: bool) -> list[WorldPart]:
    rich = bool(rng.random() < 0.6)
    if bag:
        return [box(np.array([0.2, 0.07, 0.16]) * scale, draw_material(rng, 0.3 * scale, rich))]
    if rng.random() < 0.4:
        return [ball(0.17 * scale, draw_material(rng, 0.3 * scale, rich, (SEGMENTS, 4, 1)))]
    half = scale * np.array([rng.uniform(0.12, 0.18), rng.uniform(0.16, 0.26), rng.uniform(0.1, 0.2)])
    return [box(half, draw_material(rng, 0.35 * scale, rich))]


def _stand(gait: Gait, s: np.ndarray, hips: np.ndarray, arms: Arms, parts: list[WorldPart], bag: bool | None) -> list[Poses]:
    """Poses of the parts of ``body``, and of what is carried unless ``bag`` is None."""
    scale = gait.scale
    place, heading = gait.place(s)
    level = frame(np.stack([np.cos(heading), np.sin(heading), 0 * s], -1), UP)
    forward, left = level[..., 0], level[..., 1]
    hip = np.concatenate([place, hips[:, None]], 1)

    def point(x: float, y: float, z: float) -> np.ndarray:
        return np.asarray(hip + level @ (scale * np.array([x, y, z])))

    lean = level @ about(np.array([0.0, 1.0, 0.0]), np.full(len(s), 0.07))
    found: list[Poses] = [
        (level, point(0, 0, 0.02)), (lean, point(0.02, 0, 0.28)), rod(point(0.035, 0, 0.54), point(0.045, 0, 0.66), left),
        (level, point(0.06, 0, 0.75)), (level, point(0.045, 0, 0.79)),
    ]  # fmt: skip
    phase = np.pi * (s - gait.first) / gait.step
    for side in (-1, 1):
        joint = point(0, -side * HIP, 0)
        ankle, turn, middle = place_ankle(gait, s, side)
        knee = find_knee(joint, ankle, forward, THIGH * scale, SHIN * scale)
        found += [rod(joint, knee, forward), rod(knee, ankle, forward), (turn, middle)]
    hands = []
    for side in (-1, 1):
        shoulder = point(0.03, -side * SHOULDER, SHOULDER_HEIGHT)
        if arms == "forward":
            upper, bent = np.full(len(s), 0.35), np.full(len(s), 1.15)
        else:
            # An arm is foremost when the leg of its own side is furthest behind.
            swing = -side * 0.45 * np.sin(phase)
            upper, bent = (0.1 * swing if bag and side > 0 else swing), 0.25 + 0.2 * np.maximum(swing, 0)
        outward = -side * (0.0 if arms == "forward" else 0.1) * left
        elbow = shoulder + UPPER_ARM * scale * _direction(forward, upper, outward)
        hand = elbow + LOWER_ARM * scale * _direction(forward, upper + bent, 0 * left)
        found += [rod(shoulder, elbow, forward), rod(elbow, hand, forward)]
        hands.append(hand)
    if bag is None:
        return found
    if bag:
        return [*found, (level, hands[1] - [0, 0, parts[-1].size[2]])]
    return [*found, (level, 0.5 * (hands[0] + hands[1]) + (0.8 * parts[-1].size[0]) * forward)]


def _direction(forward: np.ndarray, angle: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """Return [T, 3] unit vectors that hang down at angle 0 and point forward at a right angle."""
    way = np.sin(angle)[:, None] * forward - np.cos(angle)[:, None] * UP + outward
    return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))
