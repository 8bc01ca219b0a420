"""Known errors of distance, depth trajectory, shape offset, masks and numbers come out as they went in."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from flowsplat.priors.objects import SceneObjects
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.shape_offset import ShapePoints
from flowsplat.priors.objects.solving import DynamicObject
from flowsplat.priors.objects.storage import save_objects
from flowsplat.scenes import Depth, Scene
from flowsplat_benchmarks.objects.measure import depth_scale, measure_scene
from flowsplat_benchmarks.worlds import draw_world, write_world

SEED = 43
"""A door, a rolling ball and a walker."""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Scene:
    return write_world(tmp_path_factory.mktemp("world") / "scene", draw_world(SEED, 160, 90, 10))


@pytest.fixture
def scene(rendered, tmp_path) -> Scene:
    """The truth as priors, half as large as the truth, with cameras that are called estimated."""
    shutil.copytree(rendered.folder, tmp_path / "scene")
    scene = Scene(tmp_path / "scene")
    scene.write_cameras(scene.truth.cameras)
    scene.finish_prior("cameras", method="tracks")
    scene.finish_prior("depth", method="multi-view")
    for i in scene.train_frames:
        scene.write_mask(i, scene.truth.mask(i))
        scene.write_depth(i, Depth(scene.truth.depth(i).depth / 2, np.ones((90, 160), np.float32)))
    return scene


def change(scene: Scene, function) -> None:
    """Replace the depth and the mask of every frame by what ``function(depth, mask, i)`` makes of them."""
    for i in scene.train_frames:
        depth, mask = function(scene.depth(i).depth.copy(), scene.mask(i).copy(), i)
        scene.write_depth(i, Depth(depth, np.ones_like(depth)))
        scene.write_mask(i, mask)


def test_the_truth_has_no_errors(scene):
    figures = measure_scene(scene)
    assert figures["scale"] == pytest.approx(2, rel=1e-5)
    assert figures["idf1"] == 1
    for obj in figures["objects"]:
        assert obj["found"]
        assert obj["estimated"] == obj["number"]
        assert obj["iou"] == obj["idf1"] == 1
        for name in ("ln_distance", "depth_trajectory", "shape_offset"):
            assert obj[name] == pytest.approx(0, abs=1e-5)
        assert 0.02 < obj["height"] < 1
        assert "sigma" not in obj
    scene.finish_prior("cameras", method="truth")
    assert depth_scale(scene) == 1
    scene.finish_prior("depth", method="guess")
    assert depth_scale(scene) == pytest.approx(2, rel=1e-5)


def test_what_rests_is_measured_everywhere_and_at_feet(scene):
    assert measure_scene(scene)["static"]["p90"] == pytest.approx(0, abs=1e-5)

    def wrong(depth, mask, i):
        # The lower half lies 5 % too far; feet are there.
        depth[60:] *= np.exp(0.05)
        return depth, mask

    change(scene, wrong)
    figures = measure_scene(scene)
    assert figures["static"]["median"] == pytest.approx(0, abs=1e-5)
    assert figures["feet"]["median"] in (pytest.approx(0, abs=1e-5), pytest.approx(0.05, abs=1e-5))
    assert figures["feet"]["p90"] == pytest.approx(0.05, abs=1e-5)


def test_distance_depth_trajectory_and_shape_offset_are_told_apart(scene):
    def wrong(depth, mask, i):
        depth[mask == 1] *= np.exp(0.2)
        depth[mask == 2] *= np.exp(0.1 * (-1) ** i)
        left, right = (np.arange(160)[None] // 2 % 2 == k for k in (0, 1))
        depth[(mask == 3) & left] *= np.exp(0.05)
        depth[(mask == 3) & right] *= np.exp(-0.05)
        return depth, mask

    change(scene, wrong)
    distance, depth_trajectory, shape_offset = measure_scene(scene)["objects"]
    assert distance["ln_distance"] == pytest.approx(0.2, abs=1e-4)
    assert distance["depth_trajectory"] == pytest.approx(0, abs=1e-4)
    assert depth_trajectory["depth_trajectory"] == pytest.approx(0.1, abs=1e-3)
    assert depth_trajectory["shape_offset"] == pytest.approx(0, abs=1e-4)
    assert shape_offset["shape_offset"] == pytest.approx(0.05, abs=1e-3)
    assert distance["shape_offset"] == pytest.approx(0, abs=1e-4)


def test_numbers_that_change_cost_identity_and_not_distance(scene):
    def renumbered(depth, mask, i):
        number = mask.copy()
        number[(mask == 1) & (i >= 7)] = 9  # the first object gets another number in the last three of ten frames
        number[mask == 2] = 0  # the second one is not there at all
        return depth, number

    change(scene, renumbered)
    figures = measure_scene(scene)
    first, second, third = figures["objects"]
    assert first["ln_distance"] == pytest.approx(0, abs=1e-5)
    assert first["iou"] == 1
    seen = first["frames"]
    assert first["idf1"] == pytest.approx(2 * (seen - 3) / (seen + seen - 3))
    assert not second["found"]
    assert second["ln_distance"] is None
    assert second["idf1"] == second["iou"] == 0
    right = seen - 3 + third["frames"]
    assert figures["idf1"] == pytest.approx(2 * right / (2 * (seen + third["frames"]) + second["frames"]))


def test_what_is_believed_of_an_object_goes_to_its_object(scene):
    def renumbered(depth, mask, i):
        return depth, np.where(mask == 1, 7, mask)

    change(scene, renumbered)
    frames = len(scene.train_frames)
    depth_trajectory, middles = np.zeros(frames), np.zeros((frames, 2))
    objects = [
        DynamicObject(7, depth_trajectory, middles, 0.03, True, {"contact": Cue(0.0, 0.03, 0.1)}, ShapePoints.none(), 0.0),
        DynamicObject(3, depth_trajectory, middles, 0.5, False, {}, ShapePoints.none(), 0.0),
    ]
    save_objects(scene, SceneObjects(objects, np.array([0, -1.0, 0])))
    first, second, third = measure_scene(scene)["objects"]
    assert (first["sigma"], first["cues"]) == (0.03, ["contact"])
    assert "sigma" not in second
    assert (third["sigma"], third["cues"]) == (0.5, [])
