"""Draw what rests in a random world: the ground, the sky, walls and things beside the objects, and where the camera stands."""

from __future__ import annotations

import numpy as np

from flowsplat.scenes.synthetic.worlds.casting import ROOM
from flowsplat.scenes.synthetic.worlds.ground import GroundKind, WorldGround
from flowsplat.scenes.synthetic.worlds.materials import draw_material
from flowsplat.scenes.synthetic.worlds.parts import UP, Placed, WorldPart, ball, box, cylinder, frame
from flowsplat_benchmarks.worlds.cameras import Stand
from flowsplat_benchmarks.worlds.objects import Scale
from flowsplat_benchmarks.worlds.plan import WorldPlan

SKY_DISTANCE = 90.0
"""Meters to where the sky is painted. Chosen by eye."""


def draw_ground(rng: np.random.Generator, kind: GroundKind, distance: float) -> WorldGround:
    """Return a random ground of a kind; ``distance``: meters at which most happens."""
    still, forward = np.zeros(2), np.array([0.0, 1.0])
    if kind == "slope":
        angle, steep = rng.uniform(0, 2 * np.pi), rng.uniform(0.05, 0.18)
        return WorldGround(kind, steep * np.array([np.cos(angle), np.sin(angle)]), forward)
    if kind == "steps":
        angle = np.pi / 2 + rng.uniform(-0.5, 0.5)
        direction, tread, count = np.array([np.cos(angle), np.sin(angle)]), rng.uniform(1.3, 2.8), int(rng.integers(2, 6))
        first = distance - rng.uniform(0.2, 0.8) * count * tread
        return WorldGround(kind, still, direction, tread, rng.uniform(0.1, 0.22), first, count)
    return WorldGround(kind, still, forward)


def draw_stand(
    rng: np.random.Generator, plan: WorldPlan, scale: Scale, ground: WorldGround, centers: np.ndarray, furthest: float
) -> Stand:
    place = np.array([rng.normal() * 0.2, rng.normal() * 0.2, 0.0])
    target = centers.mean((0, 1)) + rng.normal(size=3) * [0.1, 0, 0.08] * np.linalg.norm(centers.mean((0, 1)))
    if plan.ground == "none" and plan.raised:
        place[2] = -rng.uniform(0.05, 0.35)
    else:
        place[2] = float(ground.height(place[:2])) + scale.eye
    if plan.ground == "none" and not plan.raised:
        # The lowest ray of the image meets the wall behind before it meets the ground.
        below = np.arctan2(place[2], 1.25 * furthest + 1.5) - np.radians(1.5)
        half = np.arctan(0.5 / (scale.focal * scale.aspect))
        far = float(np.linalg.norm((target - place)[:2]))
        target[2] = max(target[2], place[2] + far * np.tan(half - below))
    return Stand(place, target, np.radians(rng.normal() * 2.5))


def draw_sky(rng: np.random.Generator) -> Placed:
    """Return a far room: blue above, clouds."""
    sky = draw_material(rng, 60.0, False)
    tone = rng.uniform(0.6, 0.95)
    sky[2:5] = tone * np.array([rng.uniform(0.65, 0.95), rng.uniform(0.8, 0.97), 1.0])
    sky[11], sky[12], sky[13] = rng.uniform(0.05, 0.25), rng.uniform(15, 40), 4
    return Placed(WorldPart(ROOM, np.full(3, SKY_DISTANCE), sky), np.eye(3), np.zeros(3))


def draw_scenery(
    rng: np.random.Generator, plan: WorldPlan, ground: WorldGround, centers: np.ndarray, scale: Scale, furthest: float, rich: bool
) -> list[Placed]:
    """Walls behind, and boxes, pillars and balls beside, behind and before the objects."""
    found = []

    def material(size: float) -> np.ndarray:
        return draw_material(rng, size, rich if rng.random() < 0.8 else not rich)

    def put(part: WorldPart, at: np.ndarray, half: float, yaw: float) -> None:
        """A part whose lower end stands a little in the ground."""
        turn = frame(np.array([np.cos(yaw), np.sin(yaw), 0.0]), UP)[0]
        below = float(ground.height(at + 0.5 * part.radius * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])).min())
        found.append(Placed(part, turn, np.append(at, below + half - 0.05)))

    hidden = plan.ground == "none" and not plan.raised
    behind = furthest * rng.uniform(1.15, 1.25) + 1.0
    if hidden:
        put(box([55, 0.3, 6 + behind], material(2.5)), np.array([0.0, behind + 0.3]), 6 + behind, 0.0)
    for _ in range(int(rng.integers(1, 4))):
        far = max(behind, furthest + 1.5) * rng.uniform(1.0, 2.0)
        half = np.array([rng.uniform(0.1, 0.6) * scale.wide(far), 0.3, rng.uniform(0.1, 0.35) * scale.wide(far)])
        at = np.array([rng.uniform(-0.5, 0.5) * scale.wide(far), far + 0.3])
        put(box(half, material(2.0)), at, half[2], rng.uniform(-0.4, 0.4))
    for _ in range(int(rng.integers(4, 12))):
        far = rng.uniform(0.7, 1.5) * float(rng.choice(centers.mean(1)[:, 1]))
        at = np.array([rng.uniform(-0.6, 0.6) * scale.wide(far), far])
        size = rng.uniform(0.03, 0.14) * scale.wide(far)
        if ground.front > 0 and at[1] - 1.5 * size < ground.front:
            continue
        kind = int(rng.integers(4))
        if kind == 0:
            half = size * rng.uniform(0.5, 1.2, 3)
            put(box(half, material(2 * size)), at, half[2], rng.uniform(0, np.pi))
        elif kind == 1:
            put(cylinder(0.35 * size, 2.5 * size, material(2 * size)), at, 2.5 * size, 0.0)
        elif kind == 2:
            put(ball(size, material(2 * size)), at, 0.9 * size, 0.0)
        else:
            put(cylinder(0.8 * size, 0.8 * size, material(2 * size)), at, 0.8 * size, 0.0)
    for _ in range(int(rng.integers(0, 3))):
        # Posts before the objects; thin, so that these are hidden for a while only.
        far = rng.uniform(0.4, 0.85) * float(rng.choice(centers.mean(1)[:, 1]))
        if far < 1.2 or (ground.front > 0 and far < ground.front + 0.2):
            continue
        thick = rng.uniform(0.008, 0.025) * scale.wide(far)
        tall = rng.uniform(0.15, 0.6) * scale.wide(far)
        post = box([thick, thick, tall], material(1.0)) if rng.random() < 0.5 else cylinder(thick, tall, material(1.0))
        put(post, np.array([rng.uniform(-0.4, 0.4) * scale.wide(far), far]), tall, rng.uniform(0, np.pi))
    return found
