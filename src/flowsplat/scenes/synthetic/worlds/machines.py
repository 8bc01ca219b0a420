"""Draw what moves and is no person: vehicles, balls, pendulums, doors, birds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.scenes.synthetic.worlds.ground import WorldGround
from flowsplat.scenes.synthetic.worlds.materials import CHECKERS, SEGMENTS, SPOTS, STRIPES, draw_material
from flowsplat.scenes.synthetic.worlds.parts import (
    GRAVITY,
    UP,
    Placed,
    Poses,
    WorldObject,
    WorldPart,
    about,
    ball,
    box,
    capsule,
    cylinder,
    ellipsoid,
    frame,
    rod,
    together,
    touch_nothing,
)

BALL_PATTERNS = (SEGMENTS, SPOTS, STRIPES, CHECKERS)
STOPPING_SHARE = 0.3
"""Share of vehicles and rolling balls that come to rest. Chosen by eye."""

Way = Callable[[np.ndarray], np.ndarray]
"""Seconds [T] to meters [T], 0 in the middle of the clip."""


def draw_way(rng: np.random.Generator, speed: float, duration: float, stops: bool) -> Way:
    """Even, or braking evenly to rest at 45 to 60 percent of the clip."""
    if not stops:
        return lambda times: speed * (times - duration / 2)
    end = rng.uniform(0.45, 0.6) * duration

    def braking(times: np.ndarray) -> np.ndarray:
        left = np.maximum(end - times, 0)
        return np.asarray(-speed * left**2 / end + speed * max(end - duration / 2, 0) ** 2 / end)

    return braking


def straight(rng: np.random.Generator, ground: WorldGround, heading: float) -> float:
    """Return the heading, along the treads where there are steps."""
    if ground.count == 0:
        return heading
    along = float(np.arctan2(ground.direction[0], -ground.direction[1]))
    return along if np.cos(heading - along) > 0 else along + np.pi


def vehicle(
    rng: np.random.Generator, ground: WorldGround, at: np.ndarray, heading: float, length: float, way: Way, rich: bool,
    handle: tuple[float, float] | None = None,
) -> WorldObject:  # fmt: skip
    """Return a box on four wheels that roll without slip, in the middle of the clip at ``at`` [2], ``length`` meters long.

    Args:
        handle: of a cart that is pushed: meters above the ground and behind the box.
    """
    heading = straight(rng, ground, heading)
    width, high = length * rng.uniform(0.4, 0.5), length * rng.uniform(0.16, 0.3)
    radius, base = length * rng.uniform(0.08, 0.11), 0.31 * length
    at = ground.middle_of_tread(at, 0.55 * width)
    paint, glass = draw_material(rng, 0.6 * length, rich), draw_material(rng, length, False)
    tire = draw_material(rng, radius, True, (SEGMENTS,))
    tire[2:5], tire[5:8] = rng.uniform(0.06, 0.15), rng.uniform(0.4, 0.9)
    cabin = np.array([rng.uniform(0.2, 0.32) * length, 0.46 * width, rng.uniform(0.1, 0.16) * length])
    shift = rng.uniform(-0.12, 0.05) * length
    wheels = [cylinder(radius, 0.06 * length, tire) for _ in range(4)]
    parts = [box([length / 2, width / 2, high / 2], paint), box(cabin, glass), *wheels]
    axes = frame(ground.tangent(np.array(heading)), ground.normal)[0]
    stretch = float(np.linalg.norm(ground.tangent(np.array(heading))))
    corners = [np.array([x, y, 0.0]) for x in (-base, base) for y in (-width / 2, width / 2)]
    floor, onto_axle = 1.1 * radius, Rotation.from_euler("x", -90, degrees=True).as_matrix()
    rods: list[tuple[np.ndarray, np.ndarray]] = []
    if handle is not None:
        bar = [np.array([-length / 2 - handle[1], side * 0.4 * width, handle[0]]) for side in (-1, 1)]
        rods = [(bar[0], bar[1]), *((np.array([-0.48 * length, end[1], floor + 0.8 * high]), end) for end in bar)]
        parts += [capsule(0.02, float(np.linalg.norm(end - start)), glass) for start, end in rods]

    def origin(times: np.ndarray) -> np.ndarray:
        """Return [T, 3] the point of the ground below the middle."""
        place = at + way(times)[:, None] * [np.cos(heading), np.sin(heading)]
        return np.concatenate([place, ground.height(place)[:, None]], 1)

    def poses(times: np.ndarray) -> Poses:
        below, whole = origin(times), np.broadcast_to(axes, (len(times), 3, 3))
        # The wheels' own z is their axle, to the left.
        wheel = axes @ about(np.array([0.0, 1.0, 0.0]), stretch * way(times) / radius) @ onto_axle
        found: list[Poses] = [
            (whole, below + axes @ [0, 0, floor + high / 2]), (whole, below + axes @ [shift, 0, floor + high + cabin[2]]),
        ]  # fmt: skip
        found += [(wheel, below + axes @ (corner + [0, 0, radius])) for corner in corners]
        found += [rod(below + axes @ start, below + axes @ end, axes[:, 0]) for start, end in rods]
        return together(found)

    def touching(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points = np.stack([origin(times) + axes @ corner for corner in corners], 1)
        return points, np.ones(points.shape[:2], bool)

    return WorldObject("vehicle", tuple(parts), poses, touching, rolls=True)


def draw_rolling_ball(
    rng: np.random.Generator, ground: WorldGround, at: np.ndarray, heading: float, radius: float, way: Way, rich: bool
) -> WorldObject:
    """Return a ball that rolls without slip."""
    heading = straight(rng, ground, heading)
    at = ground.middle_of_tread(at, 1.2 * radius)
    tangent, normal = ground.tangent(np.array(heading)), ground.normal
    axis = np.cross(normal, tangent / np.linalg.norm(tangent))
    start = Rotation.random(random_state=rng).as_matrix()
    part = ball(radius, draw_material(rng, 2 * radius, rich, BALL_PATTERNS))

    def below(times: np.ndarray) -> np.ndarray:
        place = at + way(times)[:, None] * [np.cos(heading), np.sin(heading)]
        return np.concatenate([place, ground.height(place)[:, None]], 1)

    def poses(times: np.ndarray) -> Poses:
        turned = about(axis, float(np.linalg.norm(tangent)) * way(times) / radius) @ start
        return together([(turned, below(times) + radius * normal)])

    return WorldObject("rolling", (part,), poses, lambda times: (below(times)[:, None], np.ones((len(times), 1), bool)), rolls=True)


def in_the_air(
    rng: np.random.Generator, ground: WorldGround, at: np.ndarray, heading: float, radius: float, speed: float, duration: float,
    rich: bool, bounces: bool, rolls_on: bool = False,
) -> WorldObject:  # fmt: skip
    """Return a ball that falls freely: thrown so that it does not come down during the clip, or bouncing.

    Bounces turn the vertical speed about, whatever the slope of the ground.

    Args:
        rolls_on: whether it stays on the ground once its bounces are too low to be seen, as it must where a clip outlasts them.
    """
    heading = straight(rng, ground, heading)
    at = ground.middle_of_tread(at, 1.2 * radius)
    along = np.array([np.cos(heading), np.sin(heading)])
    lift = radius / float(ground.normal[2])  # Height of the center over the ground below it where the ball touches.
    starts, heights, speeds = [0.0], [], []
    if bounces:
        left, spring = rng.uniform(0.5, 1.6), rng.uniform(0.6, 0.85)
        heights, speeds = [left], [rng.uniform(-1.0, 1.0)]
        while starts[-1] < duration:
            falls = (speeds[-1] + np.sqrt(speeds[-1] ** 2 + 2 * GRAVITY * heights[-1])) / GRAVITY
            if falls < 0.05:
                break
            starts.append(starts[-1] + falls)
            speeds.append(spring * (GRAVITY * falls - speeds[-1]))
            heights.append(0.0)
    else:
        heights, speeds = [rng.uniform(0.3, 1.2)], [0.5 * GRAVITY * duration * rng.uniform(1.0, 1.12)]
    begin, height, rise = np.array(starts), np.array(heights), np.array(speeds)
    axis = rng.normal(size=3)
    axis *= rng.uniform(0, 10) / np.linalg.norm(axis)
    part = ball(radius, draw_material(rng, 2 * radius, rich, BALL_PATTERNS))

    def poses(times: np.ndarray) -> Poses:
        k = np.clip(np.searchsorted(begin, times, "right") - 1, 0, None)
        since = times - begin[k]
        over = height[k] + rise[k] * since - 0.5 * GRAVITY * since**2
        over = np.maximum(over, 0) if rolls_on else over
        place = at + (speed * (times - duration / 2))[:, None] * along
        center = np.concatenate([place, (ground.height(place) + lift + over)[:, None]], 1)
        return together([(np.asarray(Rotation.from_rotvec(times[:, None] * axis).as_matrix()), center)])

    def touching(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        center = poses(times)[1][:, 0]
        gap = center[:, 2] - ground.height(center[:, :2]) - lift
        return (center - radius * ground.normal)[:, None], (np.abs(gap) < 1e-6)[:, None] & bounces

    instants = tuple(float(t) for t in starts[1:] if t <= duration)
    return WorldObject("bouncing" if bounces else "thrown", (part,), poses, touching, instants)


def pendulum(
    rng: np.random.Generator, ground: WorldGround, at: np.ndarray, heading: float, size: float, duration: float, rich: bool
) -> WorldObject:
    """Return a weight of radius ``size`` on a rod from a fixed pivot, with something that holds the pivot."""
    length = max(rng.uniform(3, 8) * size, 0.4)
    clear = rng.uniform(0.15, 0.9)
    reach = rng.uniform(0.35, 0.85)
    pivot = np.append(at, float(ground.height(at)) + 1.4 * size + clear + length + 0.3 * size)
    rate = np.sqrt(GRAVITY / length)
    phase = rng.uniform(0, 2 * np.pi)
    across = np.array([-np.sin(heading), np.cos(heading), 0.0])  # The axis about which it swings.
    material = draw_material(rng, 1.5 * size, rich, BALL_PATTERNS)
    weight = [
        lambda: ball(size, material), lambda: box(size * np.array([0.8, 1.0, 0.9]), material),
        lambda: ellipsoid(size * np.array([0.6, 0.9, 1.2]), material),
    ][int(rng.integers(3))]()  # fmt: skip
    rope = capsule(max(0.02, 0.07 * size), length, draw_material(rng, length, False))

    def poses(times: np.ndarray) -> Poses:
        angle = reach * np.cos(rate * times + phase)
        turn = frame(np.cross(across, UP), UP) @ about(np.array([0.0, 1.0, 0.0]), -angle)
        down = -turn[..., 2]
        held = rod(np.broadcast_to(pivot, down.shape), pivot + length * down, across)
        return together([(turn, pivot + (length + 0.5 * size) * down), held])

    support = _gallows(rng, ground, pivot, across, length * np.sin(reach) + 1.5 * size)
    return WorldObject("pendulum", (weight, rope), poses, touch_nothing, swings=True, pivot=pivot, support=support)


def _gallows(
    rng: np.random.Generator, ground: WorldGround, pivot: np.ndarray, across: np.ndarray, reach: float
) -> tuple[Placed, ...]:
    """Return a beam along the axis on two posts, or a rod that goes up beyond all images."""
    wood, thick = draw_material(rng, 0.5, bool(rng.random() < 0.5)), 0.05
    axes = frame(across, UP)[0]
    if rng.random() < 0.4:
        return (Placed(box([thick, thick, 10.0], wood), axes, pivot + [0, 0, 10.0]),)
    half = rng.uniform(0.5, 0.9) * reach + 0.3
    placed = [Placed(box([half + thick, thick, thick], wood), axes, pivot)]
    for side in (-half, half):
        foot = pivot[:2] + side * across[:2]
        bottom = float(ground.height(foot)) - 0.2
        tall = 0.5 * (pivot[2] - bottom)
        placed.append(Placed(box([thick, thick, tall], wood), axes, np.append(foot, bottom + tall)))
    return tuple(placed)


def door(
    rng: np.random.Generator, ground: WorldGround, at: np.ndarray, heading: float, scale: float, duration: float, rich: bool
) -> WorldObject:
    """Return a door on its post that opens or closes; closed it lies along ``heading``."""
    wide, tall = scale * rng.uniform(0.75, 1.1), scale * rng.uniform(1.6, 2.2)
    start, sweep = rng.uniform(0, 0.4), rng.uniform(0.6, 1.5)
    side, back = float(rng.choice([-1, 1])), bool(rng.random() < 0.5)
    hinge = at - 0.5 * wide * np.array([np.cos(heading), np.sin(heading)])

    def angle(times: np.ndarray) -> np.ndarray:
        w = np.clip(times / duration, 0, 1)
        w = w * w * (3 - 2 * w)
        return np.asarray(heading + side * (start + sweep * (1 - w if back else w)))

    swept = angle(np.linspace(0, duration, 12))
    reached = hinge + wide * np.stack([np.cos(swept), np.sin(swept)], -1)
    bottom = float(max(ground.height(reached).max(), ground.height(hinge))) + 0.03
    panel = box([wide / 2, 0.03 * scale, tall / 2], draw_material(rng, 0.6 * scale, rich))
    handle = ellipsoid([0.05 * scale, 0.09 * scale, 0.03 * scale], draw_material(rng, 0.1, False))

    def poses(times: np.ndarray) -> Poses:
        heads = angle(times)
        turn = frame(np.stack([np.cos(heads), np.sin(heads), 0 * heads], -1), UP)
        corner = np.append(hinge, bottom)
        return together([(turn, corner + turn @ [wide / 2, 0, tall / 2]), (turn, corner + turn @ [0.92 * wide, 0, 0.48 * tall])])

    wood, thick = draw_material(rng, 0.5, bool(rng.random() < 0.5)), 0.05 * scale
    axes = frame(np.array([np.cos(heading), np.sin(heading), 0.0]), UP)[0]
    places = [hinge - thick * 1.1 * axes[:2, 0]]
    if rng.random() < 0.6:
        places.append(hinge + (wide + thick * 1.3) * axes[:2, 0])
    support = []
    for place in places:
        low = float(ground.height(place)) - 0.2
        half = 0.5 * (bottom + tall + 0.06 - low)
        support.append(Placed(box([thick, thick, half], wood), axes, np.append(place, low + half)))
    if len(places) == 2:
        middle = np.append(0.5 * (places[0] + places[1]), bottom + tall + 0.06 + thick)
        support.append(Placed(box([0.5 * wide + 2.3 * thick, thick, thick], wood), axes, middle))
    pivot = np.append(hinge, bottom)
    return WorldObject("door", (panel, handle), poses, touch_nothing, swings=True, pivot=pivot, support=tuple(support))


def flier(
    rng: np.random.Generator,
    ground: WorldGround,
    at: np.ndarray,
    heading: float,
    size: float,
    speed: float,
    duration: float,
    rich: bool,
) -> WorldObject:
    """Return a bird, ``size`` meters from tip to tip of its wings, that flaps or glides."""
    high = float(ground.height(at)) + rng.uniform(0.8, 3.0) + size
    bend, climb = rng.uniform(-0.4, 0.4), rng.uniform(-0.3, 0.3)
    swing, rate, phase = rng.uniform(0, 0.15, 3), rng.uniform(2, 5, 3), rng.uniform(0, 2 * np.pi, 3)
    flaps, beat = (rng.uniform(0.4, 0.8), rng.uniform(2, 5)) if rng.random() < 0.65 else (0.06, 0.7)
    body, feathers = draw_material(rng, 0.5 * size, rich), draw_material(rng, 0.6 * size, rich)
    wing = np.array([0.11, 0.23, 0.012]) * size
    parts: tuple[WorldPart, ...] = (
        ellipsoid(np.array([0.24, 0.08, 0.075]) * size, body), ellipsoid(np.array([0.07, 0.055, 0.055]) * size, feathers),
        box(wing, feathers), box(wing, feathers), box(np.array([0.09, 0.07, 0.012]) * size, feathers),
    )  # fmt: skip

    def path(times: np.ndarray) -> np.ndarray:
        s = times - duration / 2
        middle, chord = heading + 0.5 * bend * s, speed * s * np.sinc(0.5 * bend * s / np.pi)
        flat = np.stack([at[0] + chord * np.cos(middle), at[1] + chord * np.sin(middle), high + climb * s], -1)
        return np.asarray(flat + swing * np.sin(rate * times[:, None] + phase))

    def poses(times: np.ndarray) -> Poses:
        center = path(times)
        axes = frame(path(times + 1e-3) - path(times - 1e-3), UP)
        angle = 0.15 + flaps * np.sin(2 * np.pi * beat * times + phase[0])
        found: list[Poses] = [(axes, center), (axes, center + axes @ [0.27 * size, 0, 0.03 * size])]
        for side in (-1, 1):
            turned = axes @ about(np.array([1.0, 0.0, 0.0]), side * angle)
            joint = center + axes @ [0.03 * size, side * 0.05 * size, 0.04 * size]
            found.append((turned, joint + turned @ [0, side * wing[1], 0]))
        return together([*found, (axes, center + axes @ [-0.3 * size, 0, 0])])

    return WorldObject("flier", parts, poses, touch_nothing)
