"""What ties an object to the still world: laws of motion, contact, bounces, and how they are put together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import rigid
from flowsplat.priors.background.ground import Ground, find_ground, static_points
from flowsplat.priors.objects.contact import Bound, compute_ground_bound, middle_of, upright_ratio
from flowsplat.priors.objects.contact_cues import Feet, contact_cue, find_jumps, foot_offset, make_thrown_cue, settle_on_ground
from flowsplat.priors.objects.depth_trajectory import check_laws
from flowsplat.priors.objects.distance import Cue, combine
from flowsplat.priors.objects.path import WorldPath, bounce_frames, constant_height, pivot
from flowsplat.priors.objects.rigid import TrackObservations, solve_rigid
from flowsplat.priors.objects.shape_offset import roundness
from tests.priors.objects.test_rigid import body, turn

K = np.array([[300.0, 0, 160], [0, 300.0, 90], [0, 0, 1]])
UP = np.array([0.0, 0, 1])


def look(center: np.ndarray, at: np.ndarray, roll: float = 0.0) -> Camera:
    """A camera at ``center`` that looks ``at`` a point; world z is up."""
    forward = (at - center) / np.linalg.norm(at - center)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right)
    R = turn(roll, axis=2) @ np.stack([right, np.cross(forward, right), forward])
    return Camera(rigid(R, -R @ center), K, 320, 180)


CAMERA = look(np.array([0, 0, 1.6]), np.array([0, 6.0, 1.0]))


def seen_ground(step: float | None = None, wall: bool = True) -> Ground | None:
    """The ground of points on the plane z = 0 before a wall; with ``step`` everything at y > 6 lies that much higher."""
    rng = np.random.default_rng(0)
    floor = rng.uniform([-5, 2, 0], [5, 12, 0], (20000, 3))
    floor[:, 2] = 0 if step is None else step * (floor[:, 1] > 6)
    back = rng.uniform([-5, 12, 0], [5, 12, 4], (4000 if wall else 0, 3))
    points = np.concatenate([floor, back]) + rng.normal(0, 0.003, (len(floor) + len(back), 3))
    normals = np.concatenate([np.tile(UP, (len(floor), 1)), np.tile([0.0, -1, 0], (len(back), 1))])
    return find_ground(points, normals, CAMERA.project(points)[1], [CAMERA])


def image_of(camera: Camera, low: np.ndarray, width: float, height: float) -> np.ndarray:
    """bool [180, 320]: an upright billboard with the middle of its lower edge at ``low``, that faces the camera."""
    away = low - camera.center
    side = np.cross(away, UP)
    side /= np.linalg.norm(side)
    facing = np.array([away[0], away[1], 0]) / np.linalg.norm(away[:2])
    y, x = np.mgrid[:180, :320]
    rays = camera.unproject(np.stack([x, y], -1) + 0.5, np.ones((180, 320))) - camera.center
    t = (away @ facing) / (rays @ facing)
    hit = camera.center + t[..., None] * rays - low
    return (t > 0) & (np.abs(hit @ side) < width / 2) & (hit[..., 2] > 0) & (hit[..., 2] < height)


def test_the_ground_and_its_steps():
    ground = seen_ground(step=0.5)
    assert ground is not None
    assert ground.normal @ UP > 0.999
    camera = look(np.array([0, 0, 1.6]), np.array([0, 6.0, 0.6]))
    for y, z in ((4.0, 0.0), (9.0, 0.5)):
        pixel, depth = camera.project(np.array([[0.3, y, z]]))
        found, known = ground.depth(camera, pixel)
        assert known.all()
        assert found == pytest.approx(depth, rel=0.01)
        assert ground.height(np.array([[0.3, y, z + 0.2]])) == pytest.approx(0.2, abs=0.02)
    assert np.isinf(ground.depth(camera, np.array([[160.0, 5.0]]))[0]).all()
    assert len(ground.depth(camera, np.zeros((0, 2)))[0]) == 0


def test_ground_that_was_not_seen_is_supposed_to_go_on_where_it_is_one_plane():
    aside = look(np.array([0, 0, 1.6]), np.array([9.0, 4.0, 0.0]))
    true = aside.project(np.array([[9.0, 4.0, 0.0]]))[1]
    flat, steps = seen_ground(), seen_ground(step=0.5)
    assert flat is not None
    assert steps is not None
    depth, known = flat.depth(aside, np.array([[160.0, 90.0]]))
    assert not known.any()
    assert depth == pytest.approx(true, rel=0.01)
    assert np.isnan(flat.height(np.array([[20.0, 5.0, 0.0]]))).all()
    if steps.share < 0.5:
        assert np.isinf(steps.depth(aside, np.array([[160.0, 90.0]]))[0]).all()


def test_no_ground_where_none_is_in_sight():
    rng = np.random.default_rng(0)
    wall = rng.uniform([-4, 8, 0], [4, 8.01, 4], (2000, 3))
    camera = look(np.array([0, 0, 1.6]), np.array([0, 8.0, 1.6]))
    normals = np.tile([0.0, -1, 0], (len(wall), 1))
    assert find_ground(wall, normals, camera.project(wall)[1], [camera]) is None
    assert find_ground(wall[:0], normals[:0], np.zeros(0), [camera]) is None


def test_points_and_normals_of_depth():
    camera = look(np.array([0, 0, 1.6]), np.array([0, 6.0, 0.0]))
    y, x = np.mgrid[:180, :320]
    rays = camera.unproject(np.stack([x, y], -1) + 0.5, np.ones((180, 320))) - camera.center
    depth = np.where(rays[..., 2] < -0.05, 1.6 / np.maximum(-rays[..., 2], 1e-9), 30.0)
    points, normals, found = static_points([depth], [rays[..., 2] < -0.05], [camera])
    assert np.abs(points[:, 2]).max() < 1e-6
    assert (normals @ UP > 0.99).all()
    np.testing.assert_allclose(camera.project(points)[1], found)


ALONE = np.zeros((180, 320), bool)
"""No other objects."""


def seen_static(camera: Camera, edge: float = np.inf, far: float = 12.0) -> np.ndarray:
    """Planar depth [90, 160] of a ground that ends ``edge`` away from the world's origin, before a wall so ``far`` away."""
    y, x = np.mgrid[:90, :160]
    rays = camera.unproject(2 * np.stack([x, y], -1) + 1.0, np.ones((90, 160))) - camera.center
    ground = np.where(rays[..., 2] < 0, camera.center[2] / np.maximum(-rays[..., 2], 1e-9), np.inf)
    return np.minimum(np.where(ground * rays[..., 1] < edge, ground, np.inf), far)


@pytest.mark.parametrize("roll", [0.0, 0.1])
@pytest.mark.parametrize("height", [1.6, 4.0])
def test_what_stands_is_where_its_feet_are(roll, height):
    ground = seen_ground()
    assert ground is not None
    camera = look(np.array([0, 0, height]), np.array([0, 6.0, 0.8]), roll)
    mask = image_of(camera, np.array([0.4, 6.0, 0.0]), 0.5, 1.7)
    static = seen_static(camera)
    bound = compute_ground_bound(mask, ALONE, camera, ground, static)
    assert bound is not None
    assert bound.visible
    middle = middle_of(mask)
    ray = camera.unproject(middle[None], np.ones(1))[0] - camera.center
    true = np.log(6.0 / ray[1])  # planar depth at which the ray through the middle meets the billboard's plane
    assert bound.log_depth == pytest.approx(true, abs=0.02)


def test_feet_behind_the_edge_of_the_ground_say_nothing():
    """A terrace ends 7 away; who walks behind it, lower, is seen from the knees up."""
    ground = seen_ground()
    assert ground is not None
    camera = look(np.array([0, 0, 1.6]), np.array([0, 6.0, 0.8]))
    edge = float(camera.project(np.array([[0, 7.0, 0.0]]))[0][0, 1])
    walker = image_of(camera, np.array([0, 10.0, -1.0]), 0.6, 1.7)
    walker[int(edge) :] = False
    assert walker.sum() > 300
    assert compute_ground_bound(walker, ALONE, camera, ground, seen_static(camera, edge=7.0, far=40.0)) is None
    before = image_of(camera, np.array([0, 5.0, 0.0]), 0.6, 1.7)
    assert compute_ground_bound(before, ALONE, camera, ground, seen_static(camera, edge=7.0, far=40.0)) is not None


def test_what_is_deep_is_where_its_middle_stands():
    """Near wheels and far ones: the nearest of its lowest pixels is nearer than its middle."""
    ground = seen_ground()
    assert ground is not None
    camera = look(np.array([0, 0, 1.6]), np.array([0, 6.0, 0.8]))
    wheels = [image_of(camera, np.array([x, 6.0 + 0.5 * x, 0.0]), 0.3, 0.3) for x in (-0.8, 0.8)]
    bonnet = image_of(camera, np.array([0, 6.0, 0.3]), 1.9, 0.6)
    mask = wheels[0] | wheels[1] | bonnet
    bound = compute_ground_bound(mask, ALONE, camera, ground, seen_static(camera))
    assert bound is not None
    middle = middle_of(mask)
    ray = camera.unproject(middle[None], np.ones(1))[0] - camera.center
    assert bound.log_depth == pytest.approx(np.log(6.0 / ray[1]), abs=0.02)
    assert bound.lowest_log_depth < bound.log_depth - 0.04


def test_who_dances_stands_and_what_flies_does_not():
    """Bounds that change by a third with the pose are contact, less sure; those of something thrown are none."""
    visible = np.ones(30, bool)
    wave = np.sin(np.linspace(0, 9, 30))
    even, uneven, thrown = (contact_cue(size * wave, visible, 30) for size in (0.04, 0.2, 0.6))
    assert even is not None
    assert uneven is not None
    assert thrown is None
    assert uneven.wrong > even.wrong
    assert uneven.sigma > even.sigma
    assert contact_cue(0.04 * wave, visible & (np.arange(30) < 10), 30) is None, "its feet are hidden in most frames"


def test_a_mask_that_holds_something_else_for_a_while_stands_all_the_same():
    """Seven frames with a shadow, one without feet: most agree, and both ends of what does not are jumps."""
    bounds, visible = 0.3 + 0.01 * np.sin(np.arange(40)), np.ones(40, bool)
    spoiled = bounds.copy()
    spoiled[4:11] -= 0.6
    spoiled[25] += 0.4
    jumps = find_jumps(spoiled, visible, 40)
    np.testing.assert_array_equal(np.flatnonzero(jumps), [*range(4, 11), 25])
    assert contact_cue(spoiled, visible, 40) is None
    stands = contact_cue(spoiled, visible & ~jumps, 40)
    assert stands is not None
    assert stands == pytest.approx(contact_cue(bounds, visible & ~jumps, 40))
    assert Feet.of([None if np.isnan(b) else Bound(b, b, True, True, np.zeros((0, 2), int)) for b in spoiled], 40).unevenness(
        np.zeros(40)
    ) == pytest.approx(0.02, abs=0.01)


def test_what_bounces_does_not_jump_and_what_jumps_most_of_the_time_says_nothing():
    """Half a meter up at five meters, twice a second, in 24 frames a second: no step of two frames is a jump."""
    time = np.arange(40) / 24
    height = 4 * 0.1 * (2 * time % 1) * (1 - 2 * time % 1)
    assert not find_jumps(height, np.ones(40, bool), 40).any()
    restless = np.where(np.arange(40) % 3 == 0, 0.5, 0.0) + np.where(np.arange(40) % 3 == 1, 1.0, 0.0)
    assert not find_jumps(restless, np.ones(40, bool), 40).any(), "no third of the frames is most of them"


def test_a_part_that_ends_on_another_object_stands_on_no_ground_that_was_not_seen():
    ground = seen_ground()
    assert ground is not None
    camera = look(np.array([0, 0, 4.0]), np.array([0, 6.0, 0.8]))
    walker = image_of(camera, np.array([0, 6.0, 0.0]), 0.5, 1.7)
    head = walker.copy()
    head[int(np.nonzero(walker)[0].mean()) :] = False
    supposed = replace(ground, heights=np.full_like(ground.heights, np.nan))
    static = np.full((90, 160), np.inf)
    for known, visible in ((supposed, False), (ground, True)):
        bound = compute_ground_bound(head, walker & ~head, camera, known, static)
        assert bound is not None
        assert bound.visible == visible
    alone = compute_ground_bound(head, ALONE, camera, supposed, static)
    assert alone is not None
    assert alone.visible


def test_what_floats_is_bounded_from_afar_and_hidden_feet_are_noticed():
    ground = seen_ground()
    assert ground is not None
    camera = look(np.array([0, 0, 1.6]), np.array([0, 6.0, 0.8]))
    standing = compute_ground_bound(image_of(camera, np.array([0, 6.0, 0.0]), 0.5, 1.0), ALONE, camera, ground, seen_static(camera))
    floating = compute_ground_bound(image_of(camera, np.array([0, 6.0, 0.5]), 0.5, 1.0), ALONE, camera, ground, seen_static(camera))
    hidden = compute_ground_bound(
        image_of(camera, np.array([0, 6.0, 0.2]), 0.5, 1.0), ALONE, camera, ground, np.full((90, 160), 3.0)
    )
    assert standing is not None
    assert floating is not None
    assert hidden is not None
    assert floating.log_depth > standing.log_depth + 0.2
    assert not hidden.visible
    assert compute_ground_bound(np.zeros((180, 320), bool), ALONE, camera, ground, np.full((90, 160), 3.0)) is None


def test_an_upright_billboard_is_not_flat_in_planar_depth():
    camera = look(np.array([0, 0, 4.0]), np.array([0, 5.0, 0.5]))
    points = np.array([[0.0, 5, 1.5], [0.0, 5, 0.8], [0.0, 5, 0.0]])
    pixels, depth = camera.project(points)
    assert upright_ratio(camera, UP, pixels[1], pixels) == pytest.approx(depth / depth[1], rel=1e-6)
    assert depth[2] > 1.1 * depth[0]
    down = look(np.array([0, 4.999, 6.0]), np.array([0, 5.0, 0.0]))
    assert upright_ratio(down, UP, np.array([160.0, 90.0]), pixels) == pytest.approx(1.0)


def moving_scene(law: str, seed: int = 0, noise: float = 0.15, standing: bool = False) -> tuple[WorldPath, float]:
    """The path of a body, from its pixels, and its true ln s."""
    rng = np.random.default_rng(seed)
    frames, points = 40, body(60, seed)
    cameras, pixels, depths = [], np.zeros((60, frames, 2), np.float32), []
    for t in range(frames):
        u = t / frames
        center = np.array([1.2 * np.sin(2.5 * u), 0.3 * np.cos(3 * u), 1.6 + 0.25 * np.sin(9 * u)])
        center = np.array([0.0, 0.3, 1.6]) if standing else center
        cameras.append(look(center, np.array([0, 6.0, 1.2])))
        if law == "pendulum":
            angle = 0.6 * np.sin(7 * u)
            R = turn(angle, axis=1)
            place = np.array([0, 6.0, 3.5]) + R @ np.array([0, 0, -2.0])
        elif law == "hopping":
            since = (t + 5) % 15 / 15
            R, place = turn(3 * u, axis=2), np.array([-1 + 2 * u, 6.0, 0.6 + 2.4 * since * (1 - since)])
        else:
            R, place = turn(3 * u, axis=2), np.array([-1 + 2 * u, 6.0 + 0.4 * np.sin(5 * u), 0.6])
        world = points @ R.T + place
        uv, _ = cameras[t].project(world)
        pixels[:, t] = uv + rng.normal(0, noise, uv.shape)
        depths.append(cameras[t].project(place)[1])
    motion = solve_rigid(TrackObservations.of_tracks(pixels, np.ones((60, frames), bool), K))
    assert motion is not None
    return WorldPath.of(motion, cameras), float(np.median(np.log(depths) - motion.log_depths()))


def test_what_swings_about_a_fixed_point():
    path, true = moving_scene("pendulum")
    law = pivot(path)
    assert law.usable
    assert -np.log(law.nearness) == pytest.approx(true, abs=0.05)
    cues, _ = check_laws(path, UP)
    assert cues["pivot"].log_scale == pytest.approx(true, abs=0.06)


def test_what_keeps_its_height():
    path, true = moving_scene("rolling")
    law = constant_height(path, UP)
    assert law.usable
    assert law.measures["explained"] > 0.3
    assert -np.log(law.nearness) == pytest.approx(true, abs=0.05)


@pytest.mark.parametrize("law", ["pendulum", "rolling"])
def test_a_standing_camera_tells_no_distance(law):
    path, _ = moving_scene(law, standing=True)
    cues, laws = check_laws(path, UP)
    assert not cues
    assert not any(each.usable for each in laws.values())


def test_standing_and_flying():
    frames, rng = np.arange(48), np.random.default_rng(0)
    visible = np.ones(48, bool)
    stands = contact_cue(0.3 + rng.normal(0, 0.015, 48), visible, 48)
    assert stands is not None
    assert stands.log_scale == pytest.approx(0.3, abs=0.02)
    assert contact_cue(0.6 + 0.3 * np.cos(frames / 6), visible, 48) is None
    assert contact_cue(np.full(48, 0.3), np.zeros(48, bool), 48) is None
    assert contact_cue(np.full(48, 0.3), frames < 12, 48) is None


@pytest.mark.parametrize("wrong", [0.8, 1.0, 1.3])
def test_what_hops_is_thrown_up_at_its_bounces(wrong):
    path, true = moving_scene("hopping")
    assert bounce_frames(path, UP, float(np.exp(true)) * wrong) == pytest.approx([10, 25], abs=1)


@pytest.mark.parametrize("law", ["pendulum", "rolling"])
def test_what_swings_or_rolls_does_not_bounce(law):
    path, true = moving_scene(law)
    assert len(bounce_frames(path, UP, float(np.exp(true)))) == 0


def test_the_nearest_bound_at_a_bounce_speaks():
    bounds = np.full(40, 0.8)
    bounds[[10, 25]] = 0.31, 0.44
    cue = make_thrown_cue(bounds, np.array([11, 25]))
    assert cue is not None
    assert cue.log_scale == pytest.approx(0.31)
    once = make_thrown_cue(bounds, np.array([25]))
    assert once is not None
    assert once.sigma > cue.sigma
    assert make_thrown_cue(bounds, np.zeros(0, int)) is None
    assert make_thrown_cue(np.full(40, np.nan), np.array([10])) is None


def test_a_round_body_touches_the_ground_behind_its_front():
    y, x = np.mgrid[:60, :80]
    mask = np.hypot(x - 40, y - 30) < 20
    front, lowest = roundness(mask, 300.0), np.array([[39, 49], [40, 49], [41, 49]])
    none = np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    rim = foot_offset(lowest, front, *none)
    assert rim == pytest.approx(0.75 / 300 * (20 * 0.71 - np.sqrt(2 * 20 - 1)), abs=0.003)  # less the height of its last pixel
    # Points of its own near there know better; those far away say nothing.
    near, far = np.tile([[40.0, 47.0]], (8, 1)), np.tile([[40.0, 11.0]], (8, 1))
    assert foot_offset(lowest, front, near, np.full(8, -0.02), np.full(8, 0.001)) == pytest.approx(rim - 0.02, abs=1e-6)
    assert foot_offset(lowest, front, far, np.full(8, -0.02), np.full(8, 0.001)) == pytest.approx(rim)


def test_cues_are_combined_by_their_sureness():
    alone = combine(0.0, {}, [])
    assert alone.log_scale == pytest.approx(0, abs=0.01)
    assert alone.sigma > 0.2
    told = combine(0.0, {"contact": Cue(0.4, 0.03, 0.07)}, [])
    assert told.log_scale == pytest.approx(0.4, abs=0.03)
    assert told.sigma < alone.sigma
    both = combine(0.0, {"contact": Cue(0.4, 0.03, 0.07), "pivot": Cue(0.44, 0.03, 0.05)}, [])
    assert both.log_scale == pytest.approx(0.42, abs=0.02)
    assert both.sigma < told.sigma
    bounded = combine(0.3, {}, [0.0])
    assert bounded.log_scale < 0.05
    low = combine(0.3, {}, [], near_ground=-0.3)
    assert -0.2 < low.log_scale < 0.2
    torn = combine(0.0, {"contact": Cue(0.4, 0.03, 0.07), "pivot": Cue(-0.4, 0.03, 0.05)}, [])
    assert torn.sigma > 0.2


def test_feet_settle_a_depth_trajectory_over_time():
    rng, frames = np.random.default_rng(0), np.arange(60)
    drift = 0.05 * np.sin(frames / 12)
    seen = np.ones(60, bool)
    seen[20:24] = False
    above = np.where(seen, -drift + rng.normal(0, 0.01, 60), np.nan)
    assert np.std(drift + settle_on_ground(above, seen)) < 0.4 * np.std(drift)
    np.testing.assert_array_equal(settle_on_ground(np.full(60, np.nan), seen), 0)
