"""The street of the demo: someone walks by, a cart rolls, a ball bounces, and a camera is carried past. From a seed.

It is what people film: everything that moves touches a ground that is in sight, there are houses behind, and the sun throws
shadows. Where everything is, how it moves and what it is painted with is drawn; what there is, is not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.scenes.synthetic.worlds.cameras import Views, look, waves
from flowsplat.scenes.synthetic.worlds.casting import ROOM
from flowsplat.scenes.synthetic.worlds.ground import WorldGround
from flowsplat.scenes.synthetic.worlds.machines import in_the_air, vehicle
from flowsplat.scenes.synthetic.worlds.materials import BRICKS, PLAIN, SEGMENTS, SPOTS
from flowsplat.scenes.synthetic.worlds.parts import UP, Placed, WorldObject, WorldPart, ball, box, cylinder, ellipsoid, frame
from flowsplat.scenes.synthetic.worlds.people import walker
from flowsplat.scenes.synthetic.worlds.placing import apart, are_apart, is_free
from flowsplat.scenes.synthetic.worlds.world import Light, World

FPS = 24.0
"""Frames a second that the street is drawn at."""
STREET_SECONDS = 3.0
"""Seconds for which the street is drawn. A shorter clip shows the middle of them, a longer one all of them in more frames.
Chosen by eye."""

SEEN_SECONDS = 39 / FPS
"""Seconds in the middle for which everything that moves has to be in the image. Chosen by eye."""

EYE_HEIGHT = 1.6
"""Meters above the ground at which the camera is carried. Chosen by eye."""
FOCAL_RATIO = 0.85
"""Focal length over the width of the image. Chosen by eye."""

MIDDLE = np.array([0.0, 6.0, 0.95])
"""What the camera looks at."""

MAX_ATTEMPTS = 1000
"""How often the street is drawn anew, at most. A round number."""
_MIN_SEEN_AREA = 0.004
"""Share of the image in which each object has to be seen, at times spread over ``SEEN_SECONDS``: 230 of 57,600 pixels.
Chosen by eye."""
_SETTLE_SECONDS = 0.1
"""Seconds before the end of ``SEEN_SECONDS`` from which the ball may have no bounce left. Chosen by eye."""
_CHECK_SIZE, _CHECKED_TIMES = (80, 45), 6
"""Pixels of the small images that are looked at, and the number of times. Chosen by eye."""

Color = tuple[float, float, float]

# Red, green and blue, 0 to 1, chosen by eye; what has several takes one of them.
BRICK: tuple[Color, ...] = ((0.62, 0.33, 0.25), (0.70, 0.52, 0.38), (0.55, 0.42, 0.36))
PLASTER: tuple[Color, ...] = ((0.86, 0.78, 0.62), (0.66, 0.76, 0.78), (0.84, 0.66, 0.56), (0.78, 0.80, 0.68))
DOORS: tuple[Color, ...] = ((0.16, 0.36, 0.30), (0.20, 0.28, 0.50), (0.50, 0.16, 0.14))
LEAVES: tuple[Color, ...] = ((0.22, 0.40, 0.14), (0.32, 0.44, 0.16), (0.46, 0.40, 0.14))
MORTAR, PAVING, STONE, WOOD, IRON = (
    (0.80, 0.76, 0.70),
    (0.60, 0.56, 0.52),
    (0.66, 0.64, 0.60),
    (0.50, 0.33, 0.19),
    (0.16, 0.18, 0.20),
)
GLASS, WHITE, SKY = (0.20, 0.28, 0.36), (0.90, 0.89, 0.86), (0.62, 0.76, 0.92)


def frame_rate(frames: int) -> float:
    """Return frames a second of a clip of the street."""
    return max(FPS, (frames - 1) / STREET_SECONDS)


def draw_street(seed: int, width: int = 320, height: int = 180, frames: int = 40) -> World:
    """Return the street of a seed, the same bits for the same arguments. The number of pixels and of frames changes nothing in it.

    Raises:
        InputError: nothing could be placed in sight.
    """
    fps = frame_rate(frames)
    for attempt in range(MAX_ATTEMPTS):
        rng = np.random.default_rng([seed, 6, attempt])
        world = _place(rng, seed)
        if world is not None and _is_in_sight(world):
            start = 0.5 * (STREET_SECONDS - (frames - 1) / fps)
            return _from(replace(world, width=width, height=height, frames=frames, fps=fps), start)
    raise InputError(f"The street of seed {seed} has no place for what moves in {MAX_ATTEMPTS} attempts: choose another one.")


def _from(world: World, start: float) -> World:
    """Return the same world, its time counted from ``start`` seconds on."""

    def later(obj: WorldObject) -> WorldObject:
        return replace(
            obj, poses=lambda times: obj.poses(times + start), touching=lambda times: obj.touching(times + start),
            instants=tuple(t - start for t in obj.instants if 0 <= t - start <= world.duration),
        )  # fmt: skip

    return replace(world, path=lambda times: world.path(times + start), objects=tuple(map(later, world.objects)))


def _place(rng: np.random.Generator, seed: int) -> World | None:
    """Return one attempt, over all of ``STREET_SECONDS``; None where things are inside each other."""
    ground = WorldGround("flat", np.zeros(2), np.array([0.0, 1.0]))
    objects = _draw_objects(rng, ground)
    path = _draw_passing_camera(rng)
    static = [_sky(rng), *ground.parts(_material(rng, PAVING, BRICKS, 0.8, MORTAR, 0.16, 0.5)), *_scenery(rng)]
    around, up = np.radians(rng.choice([-1, 1]) * rng.uniform(25, 65) - 90), np.radians(rng.uniform(38, 55))
    sun = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    frames = int(STREET_SECONDS * FPS) + 1
    world = World(
        seed, 320, 180, frames, FPS, ground, "walking", FOCAL_RATIO, path, tuple(static), objects, Light(sun, 0.68, 0.58), noise=0.8
    )  # fmt: skip
    times = np.linspace(0, STREET_SECONDS, 40)
    if not are_apart(objects, times, False) or not is_free(world, path(times)[0]):
        return None
    stands = static[1 + ground.boxes :]
    return world if all(apart(placed, obj, times) for placed in stands for obj in objects) else None


def _draw_objects(rng: np.random.Generator, ground: WorldGround) -> tuple[WorldObject, ...]:
    """Return a walker, behind it a cart, and before or beside it a ball, each going left or right."""

    def heading() -> float:
        return float(rng.choice([0.0, np.pi]) + rng.uniform(-0.15, 0.15))

    def at(aside: float, far: tuple[float, float]) -> np.ndarray:
        return np.array([rng.uniform(-aside, aside), rng.uniform(*far)])

    person = walker(
        rng, ground, at(0.7, (4.8, 5.4)), heading(), rng.uniform(0.95, 1.04), rng.uniform(1.1, 1.4), STREET_SECONDS, True
    )
    speed = rng.uniform(0.8, 1.2)
    cart = vehicle(
        rng, ground, at(1.0, (6.7, 7.3)), heading(), rng.uniform(1.2, 1.6), lambda times: speed * (times - STREET_SECONDS / 2), True
    )
    thrown = in_the_air(
        rng,
        ground,
        at(1.2, (3.6, 4.2)),
        heading(),
        rng.uniform(0.13, 0.18),
        rng.uniform(0.4, 0.9),
        STREET_SECONDS,
        True,
        bounces=True,
        rolls_on=True,
    )
    return person, cart, thrown


def _draw_passing_camera(rng: np.random.Generator) -> Callable[[np.ndarray], Views]:
    """Return a camera in the hand of someone who walks past, and mostly keeps looking at the same place."""
    side, speed, gaze = rng.choice([-1.0, 1.0]), rng.uniform(0.8, 1.1), rng.uniform(0.1, 0.4)
    onward, bob, sway = rng.uniform(-0.15, 0.15), rng.uniform(0.015, 0.03), rng.uniform(0.01, 0.02)
    rate, phase, tremble = 2 * np.pi * rng.uniform(1.7, 2.0), rng.uniform(0, 2 * np.pi), waves(rng, 1.0, 5.0)
    way = np.array([side, onward, 0.0])

    def path(times: np.ndarray) -> Views:
        went = (speed * (times - STREET_SECONDS / 2))[:, None] * way
        steps = (bob * np.sin(rate * times + phase))[:, None] * UP
        places = EYE_HEIGHT * UP + went + steps + (sway * np.sin(0.5 * rate * times + phase))[:, None] * np.array([1.0, 0.0, 0.0])
        return look(places, MIDDLE + gaze * went, 0.0, np.radians(0.2) * tremble(times))

    return path


def _is_in_sight(world: World) -> bool:
    """Return whether everything that moves is well in the image for the seconds that matter, and the ball bounces in them."""
    if world.objects[-1].instants[-1] < (STREET_SECONDS + SEEN_SECONDS) / 2 - _SETTLE_SECONDS:
        return False
    grid = pixel_grid(*_CHECK_SIZE).astype(np.float64).reshape(-1, 2)
    for time in STREET_SECONDS / 2 + np.linspace(-0.5, 0.5, _CHECKED_TIMES) * SEEN_SECONDS:
        camera = world.camera_at(time, *_CHECK_SIZE)
        uv = camera.project(np.concatenate([obj.center(np.array([time])) for obj in world.objects]))[0]
        share = np.bincount(world.numbers[world.cast(camera, time, grid).part], minlength=4)[1:] / len(grid)
        if (uv < 0.06 * np.array(_CHECK_SIZE)).any() or (uv > 0.94 * np.array(_CHECK_SIZE)).any() or (share < _MIN_SEEN_AREA).any():
            return False
    return True


# -- what stands about


def _material(
    rng: np.random.Generator, color: Color, pattern: int = PLAIN, period: float = 1.0, other: Color = WHITE,
    amplitude: float = 0.12, wavelength: float = 0.5,
) -> np.ndarray:  # fmt: skip
    """Return [M] (see ``materials``): two colors in a pattern, and noise; the first color is drawn a little darker or lighter."""
    tone = np.clip(np.array(color) * rng.uniform(0.9, 1.1), 0.03, 0.95)
    return np.array([pattern, period, *tone, *other, 1.0, 0.0, 0.0, amplitude, wavelength, 5, rng.integers(1, 10000)])


def _pick(rng: np.random.Generator, colors: tuple[Color, ...]) -> Color:
    return colors[int(rng.integers(len(colors)))]


def _sky(rng: np.random.Generator) -> Placed:
    sky = _material(rng, SKY, amplitude=0.14, wavelength=28.0)
    return Placed(WorldPart(ROOM, np.full(3, 90.0), sky), np.eye(3), np.zeros(3))


def _place_part(part: WorldPart, x: float, y: float, low: float, half: float, yaw: float = 0.0) -> Placed:
    """Return a part turned by ``yaw`` about the vertical, its lower end ``low`` meters above the ground, ``half`` of its height."""
    turn = frame(np.array([np.cos(yaw), np.sin(yaw), 0.0]), UP)[0]
    return Placed(part, turn, np.array([x, y, low + half]))


def _scenery(rng: np.random.Generator) -> list[Placed]:
    """Return two houses and a wall behind, before them trees, a bench, a lamp, tubs and crates."""
    front = rng.uniform(9.8, 10.4)
    gap = rng.uniform(-0.8, 1.2)
    found = _house(rng, gap - 7.0, gap - 1.0, front, rng.uniform(4.6, 6.0), _pick(rng, BRICK), True)
    found += _house(rng, gap + 1.2, gap + 8.2, front + rng.uniform(0.2, 0.8), rng.uniform(4.4, 5.6), _pick(rng, PLASTER), False)
    wall = box([1.3, 0.15, 1.0], _material(rng, STONE, BRICKS, 0.7, MORTAR, 0.18))
    found.append(_place_part(wall, gap + 0.1, front + 0.9, -0.05, 1.0))
    for x in (rng.uniform(-3.6, -2.4), rng.uniform(2.4, 3.6)):
        found += _tree(rng, x, rng.uniform(8.6, 9.0))
    found += _bench(rng, rng.uniform(-1.2, 0.0), 9.0)
    found += _lamp(rng, rng.uniform(0.9, 1.6), 8.5)
    for x, y in ((rng.uniform(-4.6, -4.0), 7.9), (rng.uniform(4.2, 4.8), 8.0)):
        found.append(_place_part(cylinder(0.36, 0.3, _material(rng, STONE, BRICKS, 0.5, MORTAR, 0.2)), x, y, -0.02, 0.3))
        found.append(_place_part(ellipsoid([0.42, 0.42, 0.4], _leaves(rng)), x, y, 0.4, 0.4))
    for k, size in enumerate((0.3, 0.24)):
        x, y = 3.5 + rng.uniform(-0.1, 0.1) + 0.62 * k, rng.uniform(4.6, 5.0)
        found.append(
            _place_part(
                box([size] * 3, _material(rng, WOOD, BRICKS, 0.5 * size, (0.3, 0.2, 0.12), 0.3, 0.2)), x, y, -0.01, size, 0.4 + k
            )
        )
    return found


def _house(
    rng: np.random.Generator, left: float, right: float, front: float, high: float, color: Color, bricks: bool
) -> list[Placed]:
    """Return a front with windows, a door and a plinth that stand out of it by centimeters."""
    wall = (
        _material(rng, color, BRICKS, 0.46, MORTAR, 0.2, 0.8) if bricks else _material(rng, color, amplitude=0.16, wavelength=0.9)
    )
    middle, half = 0.5 * (left + right), 0.5 * (right - left)
    found = [_place_part(box([half, 2.0, high / 2], wall), middle, front + 2.0, -0.05, high / 2)]
    found.append(_place_part(box([half + 0.02, 0.06, 0.2], _material(rng, STONE, amplitude=0.25)), middle, front, -0.05, 0.2))
    found.append(_place_part(box([half + 0.1, 0.12, 0.09], _material(rng, STONE)), middle, front, high - 0.2, 0.09))
    places = np.arange(left + 0.95, right - 0.6, 1.75)
    entrance = int(rng.integers(len(places)))
    for k, x in enumerate(places):
        if k == entrance:
            found.append(_place_part(box([0.58, 0.05, 1.12], _material(rng, WHITE)), x, front, 0.1, 1.12))
            found.append(
                _place_part(
                    box([0.48, 0.07, 1.04], _material(rng, _pick(rng, DOORS), amplitude=0.25, wavelength=0.3)), x, front, 0.1, 1.04
                )
            )
            found.append(_place_part(box([0.75, 0.25, 0.06], _material(rng, STONE)), x, front, 0.0, 0.06))
        else:
            found += _window(rng, x, front, 1.0)
        if high > 4.0:
            found += _window(rng, x, front, 2.9)
    return found


def _window(rng: np.random.Generator, x: float, front: float, low: float) -> list[Placed]:
    frame_of = _material(rng, WHITE, amplitude=0.06)
    pane = _material(rng, GLASS, amplitude=0.5, wavelength=0.7)
    return [
        _place_part(box([0.48, 0.05, 0.66], frame_of), x, front, low, 0.66),
        _place_part(box([0.19, 0.06, 0.56], pane), x - 0.215, front, low + 0.1, 0.56),
        _place_part(box([0.19, 0.06, 0.56], pane), x + 0.215, front, low + 0.1, 0.56),
        _place_part(box([0.56, 0.12, 0.035], _material(rng, STONE)), x, front, low - 0.07, 0.035),
    ]  # fmt: skip


def _leaves(rng: np.random.Generator) -> np.ndarray:
    red, green, blue = _pick(rng, LEAVES)
    return _material(rng, (red, green, blue), SPOTS, 0.13, (1.4 * red + 0.05, 1.4 * green + 0.05, 1.4 * blue + 0.05), 0.5, 0.22)


def _tree(rng: np.random.Generator, x: float, y: float) -> list[Placed]:
    tall = rng.uniform(1.9, 2.3)
    found = [_place_part(cylinder(0.11, tall / 2, _material(rng, WOOD, amplitude=0.45, wavelength=0.2)), x, y, -0.02, tall / 2)]
    leaves = _leaves(rng)
    for _ in range(5):
        size = rng.uniform(0.4, 0.7)
        away = rng.uniform(-0.5, 0.5, 2)
        crown = ellipsoid([size, size, 0.8 * size], leaves)
        found.append(_place_part(crown, x + away[0], y + 0.5 * away[1], tall - 0.35 + rng.uniform(0, 0.7), 0.8 * size))
    return found


def _bench(rng: np.random.Generator, x: float, y: float) -> list[Placed]:
    wood, iron = _material(rng, WOOD, BRICKS, 0.3, (0.3, 0.2, 0.12), 0.3, 0.3), _material(rng, IRON)
    found = [
        _place_part(box([0.8, 0.2, 0.03], wood), x, y, 0.42, 0.03), _place_part(box([0.8, 0.03, 0.2], wood), x, y + 0.2, 0.5, 0.2),
    ]  # fmt: skip
    return found + [_place_part(box([0.03, 0.2, 0.22], iron), x + side, y, -0.01, 0.22) for side in (-0.65, 0.65)]


def _lamp(rng: np.random.Generator, x: float, y: float) -> list[Placed]:
    iron = _material(rng, IRON)
    return [
        _place_part(cylinder(0.05, 1.6, iron), x, y, -0.02, 1.6), _place_part(cylinder(0.1, 0.25, iron), x, y, -0.02, 0.25),
        _place_part(ball(0.16, _material(rng, WHITE, SEGMENTS, 1.0, (0.8, 0.78, 0.7))), x, y, 3.15, 0.16),
    ]  # fmt: skip
