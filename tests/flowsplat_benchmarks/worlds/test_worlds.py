"""Random worlds: the same bits for a seed, a truth that agrees with itself, and bodies that stand where they seem to."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.geometry.cameras import pixel_grid, unproject_depth
from flowsplat.scenes.synthetic.worlds.casting import BOX, CAPSULE, ELLIPSOID
from flowsplat.scenes.synthetic.worlds.parts import KINDS, WorldObject
from flowsplat.scenes.synthetic.worlds.world import World
from flowsplat_benchmarks.worlds import draw_plan, draw_world, read_objects, write_world
from flowsplat_benchmarks.worlds.cameras import CAMERAS
from flowsplat_benchmarks.worlds.drawing import MIN_GROUND_AREA
from flowsplat_benchmarks.worlds.plan import CROWD, GROUNDS
from tests.marks import slow

SEEDS = (1, 3, slow(10), slow(17), slow(54))
"""A bouncing ball and a pendulum; walkers and a vehicle on steps, blurred; walkers arm in arm; crossing walkers; vehicles."""

MANY_SEEDS = [*range(3), *map(slow, range(3, 24))]


@pytest.fixture(scope="module", params=SEEDS)
def world(request) -> World:
    """A small one."""
    return draw_world(request.param, 160, 90, 16, 12.0)


def lowest(obj: WorldObject, part: int, time: float) -> np.ndarray:
    """[3] the lowest point of a part."""
    R, c = (values[0, part] for values in obj.poses(np.array([time])))
    shape, size = obj.parts[part].shape, obj.parts[part].size
    down = R.T @ [0, 0, -1]
    if shape == BOX:
        local = np.sign(down) * size
    elif shape == ELLIPSOID:
        local = size**2 * down / np.linalg.norm(size * down)
    else:
        side = np.hypot(down[0], down[1])
        local = np.array([0, 0, np.sign(down[2]) * size[2]])
        local += size[0] * (down if shape == CAPSULE else np.array([down[0], down[1], 0]) / max(side, 1e-9))
    return R @ local + c


def test_a_seed_is_a_world():
    a, b, other = draw_world(3, 96, 54, 12), draw_world(3, 96, 54, 12), draw_world(4, 96, 54, 12)
    for i in (0, 11):
        np.testing.assert_array_equal(a.image(i), b.image(i))
        np.testing.assert_array_equal(a.geometry(i)[0], b.geometry(i)[0])
    np.testing.assert_array_equal(a.tracks().points, b.tracks().points)
    assert (a.image(0) != other.image(0)).mean() > 0.5


def test_kinds_grounds_and_cameras_are_mixed():
    plans = [draw_plan(seed) for seed in range(60)]
    assert {kind for plan in plans for kind in plan.kinds} == set(KINDS)
    assert {plan.pair for plan in plans} == {None, "crossing", "touching"}
    assert {len(plan.kinds) for plan in plans} == {1, 2, 3, 4}
    for start in (0, 20, 40):
        pairs = {(plan.ground, plan.camera) for plan in plans[start : start + 20]}
        assert len(pairs) == len(GROUNDS) * len(CAMERAS)
    single = [plan.kinds[-1] for plan in (draw_plan(seed) for seed in range(1200, 3000))]
    counts = np.array([single.count(kind) for kind in KINDS])
    assert counts.min() > 0.6 * counts.mean()


def test_dancers_are_fast_and_stand_on_the_ground():
    plans = [draw_plan(seed, dancers=True) for seed in range(20)]
    assert {kind for plan in plans for kind in plan.kinds} == {"dancer"}
    assert {len(plan.kinds) for plan in plans} == {1, 2}
    world = draw_world(4, 160, 90, 24, dancers=True)
    speeds = []
    for i in (3, 9, 15):
        inside = world.geometry(i)[1] > 0
        speeds.append(np.linalg.norm(world.flow(i, i + 1).flow[inside], axis=1))
    assert np.percentile(np.concatenate(speeds), 95) > 4  # pixels of an image that is 160 wide
    times = np.linspace(0, world.duration, 60)
    for obj in world.objects:
        soles, touching = obj.touching(times)
        above = soles[..., 2] - world.ground.height(soles[..., :2])
        assert touching.any(1).all()
        assert np.abs(above[touching]).max() < 1e-6
        assert above.min() > -1e-6


def test_crowds_have_every_kind_and_three_to_five_bodies():
    plans = [draw_plan(seed, crowd=True) for seed in range(30)]
    assert {kind for plan in plans for kind in plan.kinds} == set(CROWD)
    assert {len(plan.kinds) for plan in plans} == {3, 4, 5}


@pytest.mark.parametrize(("seeds", "min_hidden"), [((0,), 1), slow((3, 4, 5), 3)])
def test_a_crowd_passes_one_another_on_the_ground(seeds, min_hidden):
    hidden = 0
    for seed in seeds:
        world = draw_world(seed, 96, 54, 20, crowd=True)
        np.testing.assert_array_equal(world.image(9), draw_world(seed, 96, 54, 20, crowd=True).image(9))
        times = np.linspace(0, world.duration, 40)
        for obj in world.objects:
            points, touching = obj.touching(times)
            gap = points[..., 2] - world.ground.height(points[..., :2])
            np.testing.assert_allclose(gap[touching], 0, atol=2e-3)
            assert (gap > -2e-3).all()
            assert touching.any(1).all()
        hidden += any(hides_another(world, time) for time in times[::5])
    assert hidden >= min_hidden


def hides_another(world: World, time: float) -> bool:
    """Whether pixels that show an object would show one further away without it."""
    camera = world.camera_at(time)
    centers, nearest = world.poses(time)[1], world.cast_rays(camera, time)[1]
    for part in np.flatnonzero(world.numbers):
        uv = camera.project(centers[part][None])[0]
        column, row = np.floor(uv[0]).astype(int)
        if 0 <= row < world.height and 0 <= column < world.width and nearest[row, column] not in (0, world.numbers[part]):
            return True
    return False


def test_a_crowd_has_contact_shadows():
    world = draw_world(0, 96, 54, 20, crowd=True)
    without = replace(world, light=replace(world.light, occlusion=0.0), noise=0.0)
    darker = replace(world, noise=0.0).image(9) / np.maximum(without.image(9).astype(float), 1)
    mask = world.geometry(9)[1]
    assert darker[mask == 0].min() < 0.5
    assert (np.abs(darker[mask > 0] - 1) < 0.05).mean() > 0.8  # what is left are pixels at outlines


def test_a_crowd_is_not_of_dancers():
    with pytest.raises(InputError, match="not of both"):
        draw_world(0, dancers=True, crowd=True)


def test_depth_and_flow_agree_where_nothing_moves(world):
    for i, j in ((0, 1), (9, 8)):
        depth, mask = world.geometry(i)
        flow = world.flow(i, j)
        uv, _ = world.camera(j).project(unproject_depth(depth, world.camera(i)))
        moved = uv - pixel_grid(world.width, world.height)
        static = (mask == 0) & (np.abs(moved) < 400).all(-1)
        np.testing.assert_allclose(flow.flow[static], moved[static], atol=1e-3)
        # Where the flow leads and says that the point is seen, the other frame has the same depth.
        x, y = np.clip(uv, 0, [world.width - 1, world.height - 1]).astype(int)[static & flow.trusted].T
        there = world.camera(j).project(unproject_depth(depth, world.camera(i)))[1][static & flow.trusted]
        assert np.median(np.abs(world.geometry(j)[0][y, x] / there - 1)) < 0.02


def test_flow_carries_the_tracks(world):
    tracks, owners = world.tracks_and_owners()
    assert set(owners) == set(range(len(world.objects) + 1))
    np.testing.assert_array_equal(tracks.moving, owners > 0)
    for i, j in pairwise(range(0, world.frames, 5)):
        (a, _), (b, _) = (world.camera(k).project(tracks.points[:, k].astype(float)) for k in (i, j))
        flow = world.flow(i, j)
        column, row = np.floor(a).astype(int).T
        # Only points near the middle of a pixel, of the object that the pixel shows: flow jumps at outlines.
        both = tracks.visible[:, i] & tracks.visible[:, j]
        both &= (np.abs(a - np.floor(a) - 0.5) < 0.15).all(1)
        row, column = np.clip(row, 0, world.height - 1), np.clip(column, 0, world.width - 1)
        both &= world.geometry(i)[1][row, column] == owners
        both &= flow.trusted[row, column]
        if both.sum() < 5:
            continue
        error = np.linalg.norm(flow.flow[row, column] - (b - a), axis=1)[both]
        assert np.median(error) < 0.1
    visible = tracks.visible
    for i in (0, world.frames - 1):
        uv, depth = world.camera(i).project(tracks.points[visible[:, i], i].astype(float))
        seen = world.cast(world.camera(i), world.timestamps[i], uv)
        np.testing.assert_allclose(seen.depth, depth, rtol=1e-3)


@pytest.mark.parametrize("seed", MANY_SEEDS)
def test_what_touches_the_ground_stands_on_it(seed):
    world = draw_world(seed, 96, 54, 40)
    times = np.linspace(0, world.duration, 120)
    for obj in world.objects:
        points, touching = obj.touching(times)
        gap = points[..., 2] - world.ground.height(points[..., :2])
        np.testing.assert_allclose(gap[touching], 0, atol=2e-3)
        assert (gap > -2e-3).all()
        if obj.kind in ("walker", "carrier"):
            assert touching.any(1).all()  # nobody flies
            # Planted feet stay: the same foot in contact at two times has not slipped, and its sole is the foot's lowest point.
            for side in range(2):
                steps = np.linalg.norm(np.diff(points[:, side], axis=0), axis=1)
                np.testing.assert_allclose(steps[touching[1:, side] & touching[:-1, side]], 0, atol=1e-9)
            for k in np.flatnonzero(touching[:, 0])[::10]:
                sole = lowest(obj, 7, times[k])  # the left foot, after the trunk's five parts, thigh and shin
                corner = np.linalg.norm(obj.parts[7].size[:2]) * np.linalg.norm(world.ground.gradient)
                assert sole[2] - points[k, 0, 2] == pytest.approx(-corner, abs=corner + 2e-3)
        elif obj.kind == "vehicle":
            assert touching.all()
        if obj.rolls:
            # No slip: the point that touches the ground does not move.
            part = 0 if obj.kind == "rolling" else 2
            R, c = obj.poses(times)
            turns, centers = obj.poses(times[60] + np.array([-1e-5, 1e-5]))
            local = R[60, part].T @ (points[60, 0] - c[60, part])
            way = np.diff(turns[:, part] @ local + centers[:, part], axis=0)
            assert np.linalg.norm(way) / 2e-5 < 1e-2
        if obj.kind == "bouncing":
            assert obj.instants
            at = obj.touching(np.array(obj.instants))
            np.testing.assert_allclose(at[0][:, 0, 2] - world.ground.height(at[0][:, 0, :2]), 0, atol=1e-6)
            assert at[1].all()
        if obj.pivot is not None:
            assert obj.swings
            R, c = obj.poses(times)
            part = 1 if obj.kind == "pendulum" else 0
            away = np.linalg.norm(c[:, part] - obj.pivot, axis=1)
            np.testing.assert_allclose(away, away[0], rtol=1e-9)


@pytest.mark.parametrize(("seed", "kinds"), [(4, ("rolling", "rolling")), (10, ("walker", "walker")), (118, ("walker", "vehicle"))])
def test_pairs_touch_each_other(seed, kinds):
    world = draw_world(seed, 96, 54, 40)
    assert tuple(obj.kind for obj in world.objects[:2]) == kinds
    assert [world.describe(number)["touches"] for number in (1, 2)] == [2, 1]
    (first, a), (second, b) = ((obj, obj.poses(np.linspace(0, world.duration, 400))[1]) for obj in world.objects[:2])
    if kinds == ("rolling", "rolling"):
        gap = np.linalg.norm(a[:, 0] - b[:, 0], axis=1) - first.parts[0].radius - second.parts[0].radius
        assert gap.min() == pytest.approx(0, abs=2e-3)
    elif kinds == ("walker", "walker"):
        # The right upper arm of one and the left one of the other: the last four parts are arms, left first.
        gap = np.linalg.norm(a[:, -2] - b[:, -4], axis=1) - 2 * first.parts[-2].size[0]
        assert (np.abs(gap) < 0.05).all()
    else:
        # Hands, at the ends of the lower arms, and the bar, the third part from the end.
        R, c = first.poses(np.linspace(0, world.duration, 400))
        hands = c[:, [-3, -1]] + np.stack([R[:, k, :, 2] * first.parts[k].size[2] for k in (-3, -1)], 1)
        away = np.abs(hands - b[:, -3][:, None])
        assert away[..., 2].max() < 0.12
        assert np.linalg.norm(away[..., :2].min(1), axis=-1).max() < 0.35


@pytest.mark.parametrize("seed", MANY_SEEDS)
def test_objects_and_ground_are_in_sight_and_the_camera_is_free(seed):
    world, plan = draw_world(seed), draw_plan(seed)
    assert [obj.kind for obj in world.objects] == list(plan.kinds)
    count = world.ground.boxes
    grid = pixel_grid(80, 45).astype(float).reshape(-1, 2)
    seen, ground = [], []
    for time in world.timestamps[::4]:
        hits = world.cast(world.camera_at(time, 80, 45), time, grid)
        assert hits.depth.min() > 0.3
        assert np.isfinite(hits.depth).all()
        seen.append(np.bincount(world.numbers[hits.part], minlength=len(world.objects) + 1)[1:] / len(grid))
        ground.append(((hits.part >= 1) & (hits.part <= count)).mean())
    assert ((np.array(seen) > 5e-4).mean(0) >= 0.4).all()
    assert np.max(seen) < 0.5
    if plan.ground != "none":
        assert np.mean(ground) > 0.9 * MIN_GROUND_AREA


def test_a_world_becomes_a_scene(tmp_path):
    world = draw_world(1, 96, 54, 12)
    scene = write_world(tmp_path / "scene", world)
    assert scene.heldout_frames == []
    assert len(scene.truth.flow_pairs) == 22
    np.testing.assert_array_equal(scene.frame(3), world.image(3))
    np.testing.assert_array_equal(scene.truth.mask(3), world.geometry(3)[1])
    known = read_objects(scene.truth)
    assert [obj["kind"] for obj in known["objects"]] == ["bouncing", "pendulum"]
    bouncing, swinging = known["objects"]
    assert bouncing["contact"] == pytest.approx(list(world.objects[0].instants), abs=1e-5)
    assert swinging["contact"] == []
    assert swinging["swings"]
    assert swinging["pivot"] is not None
    assert len(known["tracks"]) == len(scene.truth.tracks.points)


@pytest.mark.parametrize("arguments", [(-1,), (0, 8, 8), (0, 320, 180, 3), (0, 320, 180, 40, 0.0)])
def test_what_makes_no_world_is_refused(arguments):
    with pytest.raises(InputError, match="cannot be made"):
        draw_world(*arguments)
