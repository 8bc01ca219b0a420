"""Random worlds from a seed.

What a world is about (ground, camera, kinds of movers) comes from the seed alone; where everything is gets drawn again
until all of it is in sight. So no kind is rarer because it is hard to place. Of twenty seeds that begin at a multiple of
twenty each has another pair of ground and camera. Worlds of dancers are drawn apart, with the same seeds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.scenes.synthetic.worlds.cameras import CAMERAS, CameraKind, Stand, draw_path
from flowsplat.scenes.synthetic.worlds.casting import ROOM
from flowsplat.scenes.synthetic.worlds.dancers import dancer
from flowsplat.scenes.synthetic.worlds.ground import Ground, GroundKind, draw_ground
from flowsplat.scenes.synthetic.worlds.machines import (
    STOPS,
    door,
    draw_way,
    flier,
    in_the_air,
    pendulum,
    rolling,
    straight,
    vehicle,
)
from flowsplat.scenes.synthetic.worlds.materials import draw_material
from flowsplat.scenes.synthetic.worlds.parts import KINDS, UP, Kind, Mover, Part, Placed, ball, box, cylinder, frame
from flowsplat.scenes.synthetic.worlds.people import HEIGHT, walker
from flowsplat.scenes.synthetic.worlds.placing import apart, are_apart, is_free, reach
from flowsplat.scenes.synthetic.worlds.world import Light, World

GROUNDS: tuple[GroundKind, ...] = ("flat", "slope", "steps", "none")

PAIRS = ("crossing", "touching")
"""Pairs of movers, as frequent as single ones of each kind where a world has two or more."""

CROSSING: tuple[Kind, ...] = ("walker", "carrier", "vehicle", "rolling")
TOUCHING: tuple[tuple[Kind, Kind], ...] = (("walker", "walker"), ("walker", "vehicle"), ("rolling", "rolling"))

BLURRED, NOISY = 0.3, 0.7
"""Shares of worlds with motion blur and with visible noise."""

SUNNY = 0.8
"""Share of worlds with a sun."""

ATTEMPTS = 4000
"""How often everything is placed anew at most."""

APPARENT = (0.08, 0.7)
"""Shares of the picture's height between which movers are drawn."""

DANCING = (0.5, 0.9)
"""The same of dancers."""

NEAREST, FURTHEST = 1.4, 24.0
"""Metres between which movers are drawn."""

IN_SIGHT, ENOUGH_PIXELS = 0.6, 0.0012
"""Share of the frames in which a mover's middle must be in the picture and enough of it be seen, and how much is enough: a
share of the picture (69 of 57,600 pixels)."""

LARGEST = 0.35
"""Share of the picture that a mover may fill."""

GROUND_SEEN, GROUND_UNSEEN = 0.08, 0.004
"""Share of the picture that the ground fills at least where it is to be seen, and at most where not."""

OTHER_STEPS = 0.1
"""Share of the ground in sight that a second step fills at least, where there are steps."""

SKY = 90.0
"""Metres to where the sky is painted."""

_CHECK_WIDTH, _CHECK_FRAMES = 80, 10


@dataclass(frozen=True)
class Plan:
    """What a world is about.

    Attributes:
        ground: what is seen of the ground.
        camera: how the camera moves.
        kinds: of the movers, in order.
        pair: ``crossing`` or ``touching`` where the first two movers are such a pair.
        raised: where no ground is in sight: whether it lies above the eye, or below the picture.
    """

    ground: GroundKind
    camera: CameraKind
    kinds: tuple[Kind, ...]
    pair: str | None
    raised: bool


def draw_plan(seed: int, dancers: bool = False) -> Plan:
    """What the world of a seed is about; ``dancers``: one or two of them, instead of all other movers, and no steps."""
    block, place = divmod(seed, len(GROUNDS) * len(CAMERAS))
    order = np.random.default_rng([block, 1]).permutation(len(GROUNDS) * len(CAMERAS))
    ground, camera = divmod(int(order[place]), len(CAMERAS))
    rng = np.random.default_rng([seed, 0])
    count = int(rng.integers(1, 5))
    kinds: list[Kind] = []
    pair: str | None = None
    while len(kinds) < count:
        # A pair comes first, and only where there is room for it.
        chosen = int(rng.integers(len(KINDS) + (len(PAIRS) if not kinds and count > 1 else 0)))
        if chosen < len(KINDS):
            kinds.append(KINDS[chosen])
            continue
        pair = PAIRS[chosen - len(KINDS)]
        if pair == "crossing":
            kinds = [CROSSING[k] for k in rng.integers(0, len(CROSSING), 2)]
        else:
            kinds = list(TOUCHING[int(rng.integers(len(TOUCHING)))])
    raised = bool(rng.random() < 0.5) or bool({"rolling", "bouncing"} & set(kinds))
    if dancers:
        level: GroundKind = "flat" if GROUNDS[ground] == "steps" else GROUNDS[ground]
        danced: list[Kind] = ["dancer"] * min(count, 2)
        return Plan(level, CAMERAS[camera], tuple(danced), None, raised)
    return Plan(GROUNDS[ground], CAMERAS[camera], tuple(kinds), pair, raised)


def draw_world(seed: int, width: int = 320, height: int = 180, frames: int = 40, fps: float = 24.0, dancers: bool = False) -> World:
    """The world of a seed, the same bits for the same arguments.

    Its geometry does not depend on the number of pixels, as long as their ratio stays.

    Args:
        dancers: people who swing their limbs as fast as people do, and nothing else that moves.

    Raises:
        InputError: the arguments make no clip, or nothing could be placed in sight.
    """
    if seed < 0 or min(width, height) < 32 or frames < 10 or not 0 < fps < np.inf:
        raise InputError(
            f"A random world of seed {seed} with {frames} frames of {width}x{height} pixels at {fps} frames a second cannot be "
            "made: use a seed of 0 or more, 10 frames or more of 32x32 pixels or more, and a finite rate above 0."
        )
    plan = draw_plan(seed, dancers)
    for attempt in range(ATTEMPTS):
        world = _place(np.random.default_rng([seed, 2, attempt]), seed, plan, (width, height), frames, fps)
        if world is not None and _is_in_sight(world, plan):
            return world
    raise InputError(f"The random world of seed {seed} has no place for its movers in {ATTEMPTS} attempts: choose another one.")


@dataclass(frozen=True)
class _Scale:
    """Where things have to be to be seen: the camera before it is moved looks along y from (0, 0, ``eye``)."""

    eye: float
    focal: float
    aspect: float

    def distance(self, rng: np.random.Generator, size: float, apparent: tuple[float, float] = APPARENT) -> float:
        """Metres at which something ``size`` metres tall has a random size in the picture."""
        share = np.exp(rng.uniform(*np.log(apparent)))
        return float(np.clip(size * self.focal * self.aspect / share, NEAREST, FURTHEST))

    def wide(self, distance: float) -> float:
        """Metres across the picture there."""
        return distance / self.focal


def _place(rng: np.random.Generator, seed: int, plan: Plan, size: tuple[int, int], frames: int, fps: float) -> World | None:
    """One attempt; None where things are inside each other."""
    duration = (frames - 1) / fps
    scale = _Scale(rng.uniform(1.0, 2.2), float(np.exp(rng.uniform(np.log(0.75), np.log(1.7)))), size[0] / size[1])
    middle = rng.uniform(4.0, 9.0)
    ground = draw_ground(rng, plan.ground, middle)
    rich = bool(rng.random() < 0.6)
    movers = _draw_movers(rng, plan, scale, ground, duration)
    times = np.linspace(0, duration, _CHECK_FRAMES)
    centres = np.stack([mover.centre(times) for mover in movers])
    if centres[..., 1].min() < 0.8:
        return None
    nearest, furthest = float(np.linalg.norm(centres, axis=-1).min()), float(centres[..., 1].max())
    if plan.ground == "none" and plan.raised:
        front = float(centres[..., 1].min()) - rng.uniform(0.6, 1.0) - max(reach(mover, times) for mover in movers)
        if front < 1.2:
            return None
        ground = Ground(ground.kind, ground.gradient, ground.direction, front=front)
    stand = _draw_stand(rng, plan, scale, ground, centres, furthest)
    leader = movers[int(rng.integers(len(movers)))]
    path = draw_path(rng, plan.camera, stand, nearest, duration, leader)
    surface = draw_material(rng, 1.5, rich and bool(rng.random() < 0.8))
    static = [_draw_sky(rng), *ground.parts(surface), *(placed for mover in movers for placed in mover.support)]
    for placed in _draw_scenery(rng, plan, ground, centres, scale, furthest, rich):
        if all(apart(placed, mover, times) for mover in movers):
            static.append(placed)
    up = np.radians(rng.uniform(30, 65))
    around = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    sun = rng.uniform(0.45, 0.85) if rng.random() < SUNNY else 0.0
    world = World(
        seed, *size, frames, fps, ground, plan.camera, scale.focal, path, tuple(static), tuple(movers),
        Light(direction, sun, 1.0 - 0.55 * sun), rng.uniform(0.3, 0.6) if rng.random() < BLURRED else 0.0,
        rng.uniform(1.0, 4.0) if rng.random() < NOISY else 0.4, (1, 2) if plan.pair == "touching" else None,
    )  # fmt: skip
    if not are_apart(movers, times, plan.pair == "touching"):
        return None
    return world if is_free(world, path(np.linspace(0, duration, frames))[0]) else None


# -- movers


def _draw_movers(rng: np.random.Generator, plan: Plan, scale: _Scale, ground: Ground, duration: float) -> list[Mover]:
    movers: list[Mover] = []
    if plan.pair == "touching":
        movers = _draw_touching(rng, plan.kinds[:2], scale, ground, duration)
    elif plan.pair == "crossing":
        # Both are at the same place of the picture in the middle of the clip, one behind the other, and go opposite ways.
        place, side = rng.uniform(-0.25, 0.25), rng.choice([0.0, np.pi])
        for kind, towards in zip(plan.kinds[:2], (side, side + np.pi), strict=True):
            movers.append(_draw_mover(rng, kind, scale, ground, duration, place, towards + rng.uniform(-0.3, 0.3)))
    for kind in plan.kinds[len(movers) :]:
        movers.append(_draw_mover(rng, kind, scale, ground, duration, rng.uniform(-0.36, 0.36), _draw_heading(rng)))
    return movers


def _draw_heading(rng: np.random.Generator) -> float:
    """Mostly across the picture, now and then along the view."""
    across = rng.choice([0.0, np.pi])
    return float(across + rng.normal() * 0.4 if rng.random() < 0.65 else rng.uniform(0, 2 * np.pi))


def _spot(scale: _Scale, place: float, distance: float) -> np.ndarray:
    """[2] at a distance, ``place`` widths of the picture beside its middle."""
    return np.array([place * scale.wide(distance), distance])


def _speed(rng: np.random.Generator, low: float, high: float, scale: _Scale, distance: float, duration: float) -> float:
    """Metres a second, so that at most 0.7 widths of the picture are crossed."""
    return float(min(rng.uniform(low, high), 0.7 * scale.wide(distance) / duration))


def _draw_mover(
    rng: np.random.Generator, kind: Kind, scale: _Scale, ground: Ground, duration: float, place: float, heading: float
) -> Mover:
    rich = bool(rng.random() < 0.6)
    if kind in ("walker", "carrier"):
        body = rng.uniform(0.6, 1.1)
        distance = max(scale.distance(rng, body * HEIGHT), 2.2)
        speed = rng.uniform(0.7, 1.7) * np.sqrt(body)
        return walker(rng, ground, _spot(scale, place, distance), heading, body, speed, duration, rich, kind == "carrier")
    if kind == "dancer":
        size = rng.uniform(0.7, 1.1)
        distance = max(scale.distance(rng, size * HEIGHT, DANCING), 2.2)
        return dancer(rng, ground, _spot(scale, place, distance), rng.uniform(0, 2 * np.pi), size, rich)
    if kind == "vehicle":
        length = float(np.exp(rng.uniform(np.log(0.5), np.log(3.5))))
        distance = max(scale.distance(rng, 0.45 * length), 1.2 * length + 0.8)
        speed = _speed(rng, 0.5 * length, 2 * length, scale, distance, duration)
        way = draw_way(rng, speed, duration, bool(rng.random() < STOPS))
        return vehicle(rng, ground, _spot(scale, place, distance), heading, length, way, rich)
    if kind == "door":
        size = rng.uniform(0.5, 1.05)
        distance = max(scale.distance(rng, 2 * size), 2.0)
        return door(rng, ground, _spot(scale, place, distance), rng.uniform(0, 2 * np.pi), size, duration, rich)
    if kind == "flier":
        span = float(np.exp(rng.uniform(np.log(0.4), np.log(1.6))))
        distance = max(scale.distance(rng, 0.4 * span), 2.0)
        speed = _speed(rng, 0.6, 3.5, scale, distance, duration)
        return flier(rng, ground, _spot(scale, place, distance), heading, span, speed, duration, rich)
    radius = float(np.exp(rng.uniform(np.log(0.1), np.log(0.4))))
    distance = scale.distance(rng, 2 * radius)
    if kind == "rolling":
        speed = _speed(rng, 0.4, 2.5, scale, distance, duration)
        way = draw_way(rng, speed, duration, bool(rng.random() < STOPS))
        return rolling(rng, ground, _spot(scale, place, distance), heading, radius, way, rich)
    if kind == "pendulum":
        return pendulum(rng, ground, _spot(scale, place, max(distance, 2.0)), rng.uniform(0, 2 * np.pi), radius, duration, rich)
    thrown = kind == "thrown"
    if thrown:
        # It rises three metres and more: the picture has to be that high where it flies.
        distance = max(distance, rng.uniform(3.2, 5.0) * scale.focal * scale.aspect)
    speed = _speed(rng, 0.3, 3.0, scale, distance, duration)
    return in_the_air(rng, ground, _spot(scale, place, distance), heading, radius, speed, duration, rich, not thrown)


def _draw_touching(
    rng: np.random.Generator, kinds: tuple[Kind, ...], scale: _Scale, ground: Ground, duration: float
) -> list[Mover]:
    """Two who walk arm in arm, one who pushes a cart, or a ball that hits another one."""
    rich, other_rich = bool(rng.random() < 0.6), bool(rng.random() < 0.6)
    beside, heading = rng.uniform(-0.2, 0.2), _draw_heading(rng)
    if kinds == ("rolling", "rolling"):
        radius = float(np.exp(rng.uniform(np.log(0.12), np.log(0.4))))
        distance = scale.distance(rng, 2 * radius)
        heading = straight(rng, ground, heading)
        speed = _speed(rng, 0.8, 2.5, scale, distance, duration)
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
            rolling(rng, ground, at, heading, radius, first, rich),
            rolling(rng, ground, at + gap * ahead, heading, radius, second, other_rich),
        ]
    body = rng.uniform(0.75, 1.1)
    distance = max(scale.distance(rng, body * HEIGHT), 2.4)
    at, speed = _spot(scale, beside, distance), rng.uniform(0.7, 1.4)
    if kinds[1] == "walker":
        state = int(rng.integers(2**31))
        aside = 0.52 * body * np.array([np.sin(heading), -np.cos(heading)])
        # Both bend as much and step together; clothes are drawn apart.
        pair = []
        for side, clothes in ((-0.5, rich), (0.5, other_rich)):
            mover = walker(np.random.default_rng(state), ground, at + side * aside, heading, body, speed, duration, clothes)
            pair.append(_repainted(rng, mover, clothes))
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


def _repainted(rng: np.random.Generator, mover: Mover, rich: bool) -> Mover:
    """The same with other colours, parts that shared one still sharing it."""
    new: dict[bytes, np.ndarray] = {}
    parts = []
    for part in mover.parts:
        key = part.material.tobytes()
        if key not in new:
            new[key] = draw_material(rng, 0.5, rich)
        parts.append(Part(part.shape, part.size, new[key]))
    return Mover(mover.kind, tuple(parts), mover.poses, mover.touching)


# -- camera and scenery


def _draw_stand(rng: np.random.Generator, plan: Plan, scale: _Scale, ground: Ground, centres: np.ndarray, furthest: float) -> Stand:
    place = np.array([rng.normal() * 0.2, rng.normal() * 0.2, 0.0])
    target = centres.mean((0, 1)) + rng.normal(size=3) * [0.1, 0, 0.08] * np.linalg.norm(centres.mean((0, 1)))
    if plan.ground == "none" and plan.raised:
        place[2] = -rng.uniform(0.05, 0.35)
    else:
        place[2] = float(ground.height(place[:2])) + scale.eye
    if plan.ground == "none" and not plan.raised:
        # The lowest ray of the picture meets the wall behind before it meets the ground.
        below = np.arctan2(place[2], 1.25 * furthest + 1.5) - np.radians(1.5)
        half = np.arctan(0.5 / (scale.focal * scale.aspect))
        far = float(np.linalg.norm((target - place)[:2]))
        target[2] = max(target[2], place[2] + far * np.tan(half - below))
    return Stand(place, target, np.radians(rng.normal() * 2.5))


def _draw_sky(rng: np.random.Generator) -> Placed:
    """A far room: blue above, clouds."""
    sky = draw_material(rng, 60.0, False)
    tone = rng.uniform(0.6, 0.95)
    sky[2:5] = tone * np.array([rng.uniform(0.65, 0.95), rng.uniform(0.8, 0.97), 1.0])
    sky[11], sky[12], sky[13] = rng.uniform(0.05, 0.25), rng.uniform(15, 40), 4
    return Placed(Part(ROOM, np.full(3, SKY), sky), np.eye(3), np.zeros(3))


def _draw_scenery(
    rng: np.random.Generator, plan: Plan, ground: Ground, centres: np.ndarray, scale: _Scale, furthest: float, rich: bool
) -> list[Placed]:
    """Walls behind, and boxes, pillars and balls beside, behind and before the movers."""
    found = []

    def material(size: float) -> np.ndarray:
        return draw_material(rng, size, rich if rng.random() < 0.8 else not rich)

    def put(part: Part, at: np.ndarray, half: float, yaw: float) -> None:
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
        far = rng.uniform(0.7, 1.5) * float(rng.choice(centres.mean(1)[:, 1]))
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
        # Posts before the movers; thin, so that these are hidden for a while only.
        far = rng.uniform(0.4, 0.85) * float(rng.choice(centres.mean(1)[:, 1]))
        if far < 1.2 or (ground.front > 0 and far < ground.front + 0.2):
            continue
        thick = rng.uniform(0.008, 0.025) * scale.wide(far)
        tall = rng.uniform(0.15, 0.6) * scale.wide(far)
        post = box([thick, thick, tall], material(1.0)) if rng.random() < 0.5 else cylinder(thick, tall, material(1.0))
        put(post, np.array([rng.uniform(-0.4, 0.4) * scale.wide(far), far]), tall, rng.uniform(0, np.pi))
    return found


# -- what is refused


def _is_in_sight(world: World, plan: Plan) -> bool:
    """Whether movers and ground fill what they should of some small pictures."""
    width = _CHECK_WIDTH
    height = round(width * world.height / world.width)
    grid = pixel_grid(width, height).astype(np.float64).reshape(-1, 2)
    count = world.ground.boxes
    shares, inside = [], []
    treads = np.zeros(count)
    for time in np.linspace(0, world.duration, _CHECK_FRAMES):
        camera = world.camera_at(time, width, height)
        hits = world.cast(camera, time, grid)
        uv = camera.project(np.concatenate([mover.centre(np.array([time])) for mover in world.movers]))[0]
        inside.append(((uv >= 0) & (uv <= [width, height])).all(1))
        shares.append(np.bincount(world.numbers[hits.part], minlength=len(world.movers) + 1)[1:] / len(grid))
        boxes = np.array([part.size[2] for part in world.parts[1 : count + 1]])
        ground = (hits.part >= 1) & (hits.part <= count)
        tread = hits.part[ground] - 1
        treads += np.bincount(tread[hits.local[ground, 2] > boxes[tread] - 1e-4], minlength=count)
    seen = np.array(shares)
    if (seen > LARGEST).any() or (((seen > ENOUGH_PIXELS) & np.array(inside)).mean(0) < IN_SIGHT).any():
        return False
    treads = np.sort(treads) / (_CHECK_FRAMES * len(grid))
    if plan.ground == "none":
        return bool(treads.sum() <= GROUND_UNSEEN)
    return bool(treads.sum() >= GROUND_SEEN and (plan.ground != "steps" or treads[-2] >= OTHER_STEPS * treads.sum()))
