"""Random objects of a plan, each where it is seen as large as it is to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowsplat.scenes.synthetic.worlds.animals import SHOULDER_HEIGHT, animal
from flowsplat.scenes.synthetic.worlds.ground import WorldGround
from flowsplat.scenes.synthetic.worlds.machines import (
    STOPPING_SHARE,
    door,
    draw_rolling_ball,
    draw_way,
    flier,
    in_the_air,
    pendulum,
    straight,
    vehicle,
)
from flowsplat.scenes.synthetic.worlds.materials import draw_material
from flowsplat.scenes.synthetic.worlds.parts import Kind, WorldObject, WorldPart
from flowsplat.scenes.synthetic.worlds.people import WALKER_HEIGHT, walker
from flowsplat_benchmarks.worlds.dancers import dancer
from flowsplat_benchmarks.worlds.plan import WorldPlan

HEIGHT_RANGE = (0.08, 0.7)
"""Shares of the image's height between which objects are drawn. Chosen by eye."""

DANCER_HEIGHT_RANGE = (0.5, 0.9)
"""The same of dancers. Chosen by eye."""

CROWD_HEIGHT_RANGE = (0.2, 0.7)
"""The same in crowds. Chosen by eye."""

CROWD_SATURATION, CROWD_BRIGHTNESS = 0.1, (0.06, 0.5)
"""Plain clothes of a crowd: the share of a color's saturation that is left at most, and between which brightness they lie.
Chosen by eye."""

MIN_DISTANCE, MAX_DISTANCE = 1.4, 24.0
"""Meters between which objects are drawn. Chosen by eye."""


@dataclass(frozen=True)
class Scale:
    """Where things have to be to be seen: the camera before it is moved looks along y from (0, 0, ``eye``)."""

    eye: float
    focal: float
    aspect: float

    def distance(self, rng: np.random.Generator, size: float, apparent: tuple[float, float] = HEIGHT_RANGE) -> float:
        """Meters at which something ``size`` meters tall has a random size in the image."""
        share = np.exp(rng.uniform(*np.log(apparent)))
        return float(np.clip(size * self.focal * self.aspect / share, MIN_DISTANCE, MAX_DISTANCE))

    def wide(self, distance: float) -> float:
        """Meters across the image there."""
        return distance / self.focal


def draw_objects(
    rng: np.random.Generator, plan: WorldPlan, scale: Scale, ground: WorldGround, duration: float
) -> list[WorldObject]:
    objects: list[WorldObject] = []
    if plan.crowd:
        return _draw_crowd(rng, plan.kinds, scale, ground, duration)
    if plan.pair == "touching":
        objects = _draw_touching(rng, plan.kinds[:2], scale, ground, duration)
    elif plan.pair == "crossing":
        # Both are at the same place of the image in the middle of the clip, one behind the other, and go opposite ways.
        place, side = rng.uniform(-0.25, 0.25), rng.choice([0.0, np.pi])
        for kind, towards in zip(plan.kinds[:2], (side, side + np.pi), strict=True):
            objects.append(_draw_object(rng, kind, scale, ground, duration, place, towards + rng.uniform(-0.3, 0.3)))
    for kind in plan.kinds[len(objects) :]:
        objects.append(_draw_object(rng, kind, scale, ground, duration, rng.uniform(-0.36, 0.36), _draw_heading(rng)))
    return objects


def _draw_crowd(
    rng: np.random.Generator, kinds: tuple[Kind, ...], scale: Scale, ground: WorldGround, duration: float
) -> list[WorldObject]:
    """Return objects at several depths, all of which are near one place of the image in the middle of the clip; some go one way,
    some the other, so that they pass before each other."""
    place, side = rng.uniform(-0.2, 0.2), rng.choice([0.0, np.pi])
    objects = []
    for kind in kinds:
        towards = side + np.pi * (rng.random() < 0.5) + rng.uniform(-0.35, 0.35)
        obj = _draw_object(rng, kind, scale, ground, duration, place + rng.normal() * 0.12, towards, CROWD_HEIGHT_RANGE)
        objects.append(_repaint(rng, obj, rich=False, dull=bool(rng.random() < 0.8)))
    return objects


def _draw_heading(rng: np.random.Generator) -> float:
    """Mostly across the image, now and then along the view."""
    across = rng.choice([0.0, np.pi])
    return float(across + rng.normal() * 0.4 if rng.random() < 0.65 else rng.uniform(0, 2 * np.pi))


def _spot(scale: Scale, place: float, distance: float) -> np.ndarray:
    """Return [2] at a distance, ``place`` widths of the image beside its middle."""
    return np.array([place * scale.wide(distance), distance])


def _draw_speed(rng: np.random.Generator, low: float, high: float, scale: Scale, distance: float, duration: float) -> float:
    """Meters a second, so that at most 0.7 widths of the image are crossed."""
    return float(min(rng.uniform(low, high), 0.7 * scale.wide(distance) / duration))


def _draw_object(
    rng: np.random.Generator, kind: Kind, scale: Scale, ground: WorldGround, duration: float, place: float, heading: float,
    apparent: tuple[float, float] = HEIGHT_RANGE,
) -> WorldObject:  # fmt: skip
    rich = bool(rng.random() < 0.6)
    if kind in ("walker", "carrier"):
        body = rng.uniform(0.6, 1.1)
        distance = max(scale.distance(rng, body * WALKER_HEIGHT, apparent), 2.2)
        speed = rng.uniform(0.7, 1.7) * np.sqrt(body)
        return walker(rng, ground, _spot(scale, place, distance), heading, body, speed, duration, rich, kind == "carrier")
    if kind == "dancer":
        size = rng.uniform(0.7, 1.1)
        distance = max(scale.distance(rng, size * WALKER_HEIGHT, DANCER_HEIGHT_RANGE), 2.2)
        return dancer(rng, ground, _spot(scale, place, distance), rng.uniform(0, 2 * np.pi), size, rich)
    if kind == "animal":
        size = rng.uniform(0.6, 1.3)
        distance = max(scale.distance(rng, 1.4 * size * SHOULDER_HEIGHT, apparent), 2.0)
        speed = _draw_speed(rng, 0.6, 2.0, scale, distance, duration)
        return animal(rng, ground, _spot(scale, place, distance), heading, size, speed, duration, rich)
    if kind == "vehicle":
        length = float(np.exp(rng.uniform(np.log(0.5), np.log(3.5))))
        distance = max(scale.distance(rng, 0.45 * length, apparent), 1.2 * length + 0.8)
        speed = _draw_speed(rng, 0.5 * length, 2 * length, scale, distance, duration)
        way = draw_way(rng, speed, duration, bool(rng.random() < STOPPING_SHARE))
        return vehicle(rng, ground, _spot(scale, place, distance), heading, length, way, rich)
    if kind == "door":
        size = rng.uniform(0.5, 1.05)
        distance = max(scale.distance(rng, 2 * size), 2.0)
        return door(rng, ground, _spot(scale, place, distance), rng.uniform(0, 2 * np.pi), size, duration, rich)
    if kind == "flier":
        span = float(np.exp(rng.uniform(np.log(0.4), np.log(1.6))))
        distance = max(scale.distance(rng, 0.4 * span), 2.0)
        speed = _draw_speed(rng, 0.6, 3.5, scale, distance, duration)
        return flier(rng, ground, _spot(scale, place, distance), heading, span, speed, duration, rich)
    radius = float(np.exp(rng.uniform(np.log(0.1), np.log(0.4))))
    distance = scale.distance(rng, 2 * radius)
    if kind == "rolling":
        speed = _draw_speed(rng, 0.4, 2.5, scale, distance, duration)
        way = draw_way(rng, speed, duration, bool(rng.random() < STOPPING_SHARE))
        return draw_rolling_ball(rng, ground, _spot(scale, place, distance), heading, radius, way, rich)
    if kind == "pendulum":
        return pendulum(rng, ground, _spot(scale, place, max(distance, 2.0)), rng.uniform(0, 2 * np.pi), radius, duration, rich)
    thrown = kind == "thrown"
    if thrown:
        # It rises three meters and more: the image has to be that high where it flies.
        distance = max(distance, rng.uniform(3.2, 5.0) * scale.focal * scale.aspect)
    speed = _draw_speed(rng, 0.3, 3.0, scale, distance, duration)
    return in_the_air(rng, ground, _spot(scale, place, distance), heading, radius, speed, duration, rich, not thrown)


def _draw_touching(
    rng: np.random.Generator, kinds: tuple[Kind, ...], scale: Scale, ground: WorldGround, duration: float
) -> list[WorldObject]:
    """Return two who walk arm in arm, one who pushes a cart, or a ball that hits another one."""
    rich, other_rich = bool(rng.random() < 0.6), bool(rng.random() < 0.6)
    beside, heading = rng.uniform(-0.2, 0.2), _draw_heading(rng)
    if kinds == ("rolling", "rolling"):
        radius = float(np.exp(rng.uniform(np.log(0.12), np.log(0.4))))
        distance = scale.distance(rng, 2 * radius)
        heading = straight(rng, ground, heading)
        speed = _draw_speed(rng, 0.8, 2.5, scale, distance, duration)
        hit = rng.uniform(0.35, 0.65) * duration
        at = ground.middle_of_tread(_spot(scale, beside, distance), 1.2 * radius)
        gap = 2 * radius / float(np.linalg.norm(ground.tangent(np.array(heading))))
        ahead = np.array([np.cos(heading), np.sin(heading)])

        # The first one hands all of its speed to the second one.
        def first(times: np.ndarray) -> np.ndarray:
            return np.asarray(speed * np.minimum(times - hit, 0))

        def second(times: np.ndarray) -> np.ndarray:
            return np.asarray(speed * np.maximum(times - hit, 0))

        return [
            draw_rolling_ball(rng, ground, at, heading, radius, first, rich),
            draw_rolling_ball(rng, ground, at + gap * ahead, heading, radius, second, other_rich),
        ]
    body = rng.uniform(0.75, 1.1)
    distance = max(scale.distance(rng, body * WALKER_HEIGHT), 2.4)
    at, speed = _spot(scale, beside, distance), rng.uniform(0.7, 1.4)
    if kinds[1] == "walker":
        state = int(rng.integers(2**31))
        aside = 0.52 * body * np.array([np.sin(heading), -np.cos(heading)])
        # Both bend as much and step together; clothes are drawn apart.
        pair = []
        for side, clothes in ((-0.5, rich), (0.5, other_rich)):
            obj = walker(np.random.default_rng(state), ground, at + side * aside, heading, body, speed, duration, clothes)
            pair.append(_repaint(rng, obj, clothes))
        return pair
    heading = straight(rng, ground, heading)
    length = rng.uniform(0.6, 1.1) * body
    at = ground.middle_of_tread(at, 0.3)
    ahead = np.array([np.cos(heading), np.sin(heading)])
    pusher = walker(rng, ground, at, heading, body, speed, duration, rich, arms="forward")

    def way(times: np.ndarray) -> np.ndarray:
        return np.asarray(speed * (times - duration / 2))

    # The hands are 0.4 of the body's scale before the hips, and the feet reach as far.
    place, handle = at + (0.62 * body + length / 2) * ahead, (1.09 * body, 0.22 * body)
    return [pusher, vehicle(rng, ground, place, heading, length, way, other_rich, handle)]


def _repaint(rng: np.random.Generator, obj: WorldObject, rich: bool, dull: bool = False) -> WorldObject:
    """Return the same with other colors, parts that shared one still sharing it; ``dull``: as plain clothes, near to gray and
    dark."""
    new: dict[bytes, np.ndarray] = {}
    parts = []
    for part in obj.parts:
        key = part.material.tobytes()
        if key not in new:
            new[key] = draw_material(rng, 0.5, rich)
            if dull:
                new[key][2:8] = np.tile(_draw_dull(rng, new[key][2:5]), 2)
        parts.append(WorldPart(part.shape, part.size, new[key]))
    return WorldObject(obj.kind, tuple(parts), obj.poses, obj.touching)


def _draw_dull(rng: np.random.Generator, color: np.ndarray) -> np.ndarray:
    """Return a color [3] near to gray, of about the hue of ``color``."""
    gray = color.mean()
    toned = gray + rng.uniform(0, CROWD_SATURATION) * (color - gray)
    return np.asarray(toned * rng.uniform(*CROWD_BRIGHTNESS) / max(gray, 1e-3))
