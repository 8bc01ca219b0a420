"""The street of the demo: the same bits, whatever is asked for of it; and everything stands where it seems to."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.geometry.cameras import unproject_depth
from flowsplat.scenes.scene import Scene
from flowsplat.scenes.synthetic import StreetScene, encode_frames, write_synthetic, write_synthetic_video
from flowsplat.scenes.synthetic.drawn_clip import HELD_OUT_BASELINE
from flowsplat.scenes.synthetic.worlds.placing import apart, are_apart
from flowsplat.scenes.synthetic.worlds.street import FPS, MIDDLE, STREET_SECONDS, draw_street
from tests.geometry.still import camera_flow
from tests.marks import slow

SMALL = StreetScene(width=96, height=54, frames=12)
SEEDS = [3, *map(slow, range(3))]  # 3 is the demo's


def test_a_seed_is_a_street():
    again, other = (StreetScene(96, 54, 12, seed) for seed in (SMALL.seed, SMALL.seed + 1))
    for i in (0, 11):
        first, second = (spec.render(spec.camera(i), spec.timestamps[i]) for spec in (SMALL, again))
        np.testing.assert_array_equal(first.image, second.image)
        np.testing.assert_array_equal(first.depth, second.depth)
    np.testing.assert_array_equal(SMALL.tracks().points, again.tracks().points)
    assert (SMALL.render(SMALL.camera(0), 0).image != other.render(other.camera(0), 0).image).mean() > 0.5


def test_fewer_frames_show_the_middle_and_more_show_it_slower():
    whole, part = StreetScene(96, 54, 40), StreetScene(96, 54, 20)
    assert whole.fps == part.fps == FPS
    np.testing.assert_allclose(part.camera(3).viewmat, whole.camera(13).viewmat, atol=1e-12)
    np.testing.assert_allclose(part.world.geometry(3)[0], whole.world.geometry(13)[0], rtol=1e-9)
    slow = StreetScene(96, 54, 145)
    assert slow.timestamps[-1] == pytest.approx(STREET_SECONDS)
    np.testing.assert_allclose(slow.camera(2).viewmat, StreetScene(96, 54, 73).camera(1).viewmat, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_floats_sinks_or_goes_through_anything(seed):
    world = draw_street(seed, frames=73)
    times = np.linspace(0, STREET_SECONDS, 200)
    walker, cart, ball = world.objects
    assert [obj.kind for obj in world.objects] == ["walker", "vehicle", "bouncing"]
    for obj in world.objects:
        points, touching = obj.touching(times)
        assert points[..., 2].min() > -2e-3
        np.testing.assert_allclose(points[touching][:, 2], 0, atol=2e-3)
    assert walker.touching(times)[1].any(1).all()
    assert cart.touching(times)[1].all()
    assert len(ball.instants) >= 3
    assert are_apart(world.objects, times, False)
    stands = world.static[1 + world.ground.boxes :]
    assert all(apart(placed, obj, times) for placed in stands for obj in world.objects)


@pytest.mark.parametrize("seed", SEEDS)
def test_all_that_moves_is_in_every_frame(seed):
    spec = StreetScene(160, 90, 40, seed)
    for i in range(0, 40, 3):
        depth, mask = spec.world.geometry(i)
        assert np.isfinite(depth).all()
        assert (np.bincount(mask.ravel(), minlength=4)[1:] > 0.003 * mask.size).all()


def test_the_truth_agrees_with_itself():
    seen = SMALL.render(SMALL.camera(3), SMALL.timestamps[3])
    static = seen.mask == 0
    flow = SMALL.flow(3, 4)
    np.testing.assert_allclose(flow.flow[static], camera_flow(seen.depth, SMALL.camera(3), SMALL.camera(4))[static], atol=1e-3)
    for view in SMALL.heldout_views():
        own = SMALL.camera(view.frame)
        assert np.linalg.norm(view.camera.center - own.center) == pytest.approx(HELD_OUT_BASELINE * MIDDLE[1])
        aside = SMALL.render(view.camera, SMALL.timestamps[view.frame])
        shared = SMALL.covisible(view)
        assert 0.6 < shared.mean() < 1
        # What both see is in the image of the clip's own camera.
        uv, depth = own.project(unproject_depth(aside.depth, view.camera)[shared])
        assert (depth > 0).all()
        assert (uv >= 0).all()
        assert (uv < [SMALL.width, SMALL.height]).all()


def test_a_street_becomes_a_scene_and_its_frames_a_video(tmp_path):
    scene = write_synthetic(tmp_path / "scene", SMALL, holdout=10)
    assert isinstance(scene, Scene)
    np.testing.assert_array_equal(scene.frame(3), SMALL.render(SMALL.camera(3), SMALL.timestamps[3]).image)
    assert len(scene.views) == 6
    assert scene.truth is not None
    assert len(scene.truth.tracks.points) > 400
    encode_frames(tmp_path / "of_frames.mp4", scene)
    write_synthetic_video(tmp_path / "of_clip.mp4", SMALL)
    assert (tmp_path / "of_frames.mp4").read_bytes() == (tmp_path / "of_clip.mp4").read_bytes()


@pytest.mark.parametrize("arguments", [(16, 9), (320, 180, 1), (320, 180, 40, -1)])
def test_what_makes_no_street_is_refused(arguments):
    with pytest.raises(InputError, match="A clip of the street") as error:
        StreetScene(*arguments)
    assert "\n" not in str(error.value)
