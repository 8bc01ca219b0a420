"""Random worlds from a seed.

What a world is about (ground, camera, kinds of objects) comes from the seed alone; where everything is gets drawn again
until all of it is in sight. So no kind is rarer because it is hard to place. Of twenty seeds that begin at a multiple of
twenty each has another pair of ground and camera. Worlds of dancers, and of crowds, are drawn apart, with the same seeds.
"""

from __future__ import annotations

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.scenes.synthetic.worlds.ground import WorldGround
from flowsplat.scenes.synthetic.worlds.materials import draw_material
from flowsplat.scenes.synthetic.worlds.placing import apart, are_apart, is_free, reach
from flowsplat.scenes.synthetic.worlds.world import Light, World
from flowsplat_benchmarks.worlds.cameras import draw_path
from flowsplat_benchmarks.worlds.objects import Scale, draw_objects
from flowsplat_benchmarks.worlds.plan import WorldPlan, draw_plan
from flowsplat_benchmarks.worlds.scenery import draw_ground, draw_scenery, draw_sky, draw_stand

BLUR_SHARE, NOISE_SHARE = 0.3, 0.7
"""Shares of worlds with motion blur and with visible noise. Chosen by eye."""

SUN_SHARE = 0.8
"""Share of worlds with a sun. Chosen by eye."""

MAX_ATTEMPTS = 4000
"""How often everything is placed anew at most. Chosen by eye."""

OCCLUSION = 0.9
"""Of the sky's light in crowds: the ground right under a body has .1 to .4 of what it has beside it, as in photographs."""

MIN_SEEN_FRAME_SHARE, MIN_SEEN_AREA = 0.6, 0.0012
"""Share of the frames in which an object's middle must be in the image and enough of it be seen, and how much is enough: a share
of the image (69 of 57,600 pixels). Chosen by eye."""

MAX_OBJECT_SHARE = 0.35
"""Share of the image that an object may fill. Chosen by eye."""

MIN_GROUND_AREA, MAX_HIDDEN_GROUND_AREA = 0.08, 0.004
"""Share of the image that the ground fills at least where it is to be seen, and at most where not. Chosen by eye."""

MIN_SECOND_STEP_SHARE = 0.1
"""Share of the ground in sight that a second step fills at least, where there are steps. Chosen by eye."""

_CHECK_WIDTH, _CHECK_FRAMES = 80, 10
"""Pixels of width of the small images that are looked at, and their number. Chosen by eye."""


def draw_world(
    seed: int, width: int = 320, height: int = 180, frames: int = 40, fps: float = 24.0, dancers: bool = False, crowd: bool = False,
    attempts: int = MAX_ATTEMPTS,
) -> World:  # fmt: skip
    """Return the world of a seed, the same bits for the same arguments.

    Its geometry does not depend on the number of pixels, as long as their ratio stays.

    Args:
        dancers: people who swing their limbs as fast as people do, and nothing else that moves.
        crowd: three to five people, vehicles and animals that pass one another at several depths, in plain clothes and with
            contact shadows, and nothing else that moves.
        attempts: how often everything is placed anew at most.

    Raises:
        InputError: the arguments make no clip, ask for dancers and a crowd, or nothing could be placed in sight.
    """
    if dancers and crowd:
        raise InputError("A random world is of dancers or of a crowd, not of both.")
    if seed < 0 or min(width, height) < 32 or frames < 10 or not 0 < fps < np.inf:
        raise InputError(
            f"A random world of seed {seed} with {frames} frames of {width}x{height} pixels at {fps} frames a second cannot be "
            "made: use a seed of 0 or more, 10 frames or more of 32x32 pixels or more, and a finite rate above 0."
        )
    plan = draw_plan(seed, dancers, crowd)
    for attempt in range(attempts):
        world = _place(np.random.default_rng([seed, 2, attempt]), seed, plan, (width, height), frames, fps)
        if world is not None and _is_in_sight(world, plan):
            return world
    raise InputError(f"The random world of seed {seed} has no place for its objects in {attempts} attempts: choose another one.")


def _place(rng: np.random.Generator, seed: int, plan: WorldPlan, size: tuple[int, int], frames: int, fps: float) -> World | None:
    """Return one attempt; None where things are inside each other."""
    duration = (frames - 1) / fps
    scale = Scale(rng.uniform(1.0, 2.2), float(np.exp(rng.uniform(np.log(0.75), np.log(1.7)))), size[0] / size[1])
    middle = rng.uniform(4.0, 9.0)
    ground = draw_ground(rng, plan.ground, middle)
    rich = bool(rng.random() < 0.6)
    objects = draw_objects(rng, plan, scale, ground, duration)
    times = np.linspace(0, duration, _CHECK_FRAMES)
    centers = np.stack([obj.center(times) for obj in objects])
    if centers[..., 1].min() < 0.8:
        return None
    nearest, furthest = float(np.linalg.norm(centers, axis=-1).min()), float(centers[..., 1].max())
    if plan.ground == "none" and plan.raised:
        front = float(centers[..., 1].min()) - rng.uniform(0.6, 1.0) - max(reach(obj, times) for obj in objects)
        if front < 1.2:
            return None
        ground = WorldGround(ground.kind, ground.gradient, ground.direction, front=front)
    stand = draw_stand(rng, plan, scale, ground, centers, furthest)
    leader = objects[int(rng.integers(len(objects)))]
    path = draw_path(rng, plan.camera, stand, nearest, duration, leader)
    surface = draw_material(rng, 1.5, rich and bool(rng.random() < 0.8))
    static = [draw_sky(rng), *ground.parts(surface), *(placed for obj in objects for placed in obj.support)]
    for placed in draw_scenery(rng, plan, ground, centers, scale, furthest, rich):
        if all(apart(placed, obj, times) for obj in objects):
            static.append(placed)
    up = np.radians(rng.uniform(30, 65))
    around = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    sun = rng.uniform(0.45, 0.85) if rng.random() < SUN_SHARE else 0.0
    world = World(
        seed, *size, frames, fps, ground, plan.camera, scale.focal, path, tuple(static), tuple(objects),
        Light(direction, sun, 1.0 - 0.55 * sun, OCCLUSION if plan.crowd else 0.0), rng.uniform(0.3, 0.6) if rng.random() <
        BLUR_SHARE
        else 0.0, rng.uniform(1.0, 4.0) if rng.random() < NOISE_SHARE else 0.4, (1, 2) if plan.pair == "touching" else None,
    )  # fmt: skip
    if not are_apart(objects, times, plan.pair == "touching"):
        return None
    return world if is_free(world, path(np.linspace(0, duration, frames))[0]) else None


def _is_in_sight(world: World, plan: WorldPlan) -> bool:
    """Return whether objects and ground fill what they should of some small images."""
    width = _CHECK_WIDTH
    height = round(width * world.height / world.width)
    grid = pixel_grid(width, height).astype(np.float64).reshape(-1, 2)
    count = world.ground.boxes
    shares, inside = [], []
    treads = np.zeros(count)
    for time in np.linspace(0, world.duration, _CHECK_FRAMES):
        camera = world.camera_at(time, width, height)
        hits = world.cast(camera, time, grid)
        uv = camera.project(np.concatenate([obj.center(np.array([time])) for obj in world.objects]))[0]
        inside.append(((uv >= 0) & (uv <= [width, height])).all(1))
        shares.append(np.bincount(world.numbers[hits.part], minlength=len(world.objects) + 1)[1:] / len(grid))
        boxes = np.array([part.size[2] for part in world.parts[1 : count + 1]])
        ground = (hits.part >= 1) & (hits.part <= count)
        tread = hits.part[ground] - 1
        treads += np.bincount(tread[hits.local[ground, 2] > boxes[tread] - 1e-4], minlength=count)
    seen = np.array(shares)
    if (seen > MAX_OBJECT_SHARE).any() or (((seen > MIN_SEEN_AREA) & np.array(inside)).mean(0) < MIN_SEEN_FRAME_SHARE).any():
        return False
    treads = np.sort(treads) / (_CHECK_FRAMES * len(grid))
    if plan.ground == "none":
        return bool(treads.sum() <= MAX_HIDDEN_GROUND_AREA)
    return bool(treads.sum() >= MIN_GROUND_AREA and (plan.ground != "steps" or treads[-2] >= MIN_SECOND_STEP_SHARE * treads.sum()))
