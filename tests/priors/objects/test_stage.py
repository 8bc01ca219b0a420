"""The stage on a scene with a known object, its files, and bad ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.priors.depth import depth_stage
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.graph import PRIORS
from flowsplat.priors.objects import SceneObjects, load_objects, objects_stage
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.shape_offset import ShapePoints, interpolate_shape_offset
from flowsplat.priors.objects.solving import DynamicObject
from flowsplat.priors.objects.storage import save_objects
from flowsplat.priors.tracks import tracks_stage
from flowsplat.scenes import Scene
from tests.priors.planes import HEIGHT, WIDTH, write_planes


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    scene = write_planes(tmp_path_factory.mktemp("objects"), step=2, square=True)
    flow_stage(scene)
    for i in scene.train_frames:
        scene.write_mask(i, scene.truth.mask(i))
    scene.finish_prior("masks", method="truth")
    tracks_stage(scene)
    objects_stage(scene)
    return scene


def test_the_stage_tells_how_an_object_goes(scene: Scene):
    how, objects = scene.prior("objects"), load_objects(scene)
    assert how["objects"] == 1
    (obj,) = objects.objects
    seen = [k for k, i in enumerate(scene.train_frames) if scene.mask(i).any()]
    assert np.isfinite(obj.log_depth[seen]).all()
    assert obj.sigma > 0
    # Nothing ties the square to the wall behind it, so only its depth trajectory is known.
    true = np.array([np.log(np.median(scene.truth.depth(i).depth[scene.mask(i) > 0])) for i in scene.train_frames])
    error = obj.log_depth[seen] - true[seen]
    assert np.std(error) < 0.05


def test_depth_takes_objects_from_the_stage(scene: Scene):
    depth_stage(scene)
    objects = load_objects(scene)
    k = len(scene.train_frames) // 2
    i = scene.train_frames[k]
    mask = scene.mask(i)
    told = objects.depth(k, mask, scene.frame(i), scene.cameras[i])
    assert ((told > 0) == (mask > 0)).all()
    ratio = scene.depth(i).depth[mask > 0] / told[mask > 0]
    assert ratio.max() <= 1.001  # it may only stand nearer, before what it hides
    assert np.median(ratio) > 0.9


def test_files_round_trip(scene: Scene):
    before = load_objects(scene)
    save_objects(scene, before)
    after = load_objects(scene)
    for a, b in zip(before.objects, after.objects, strict=True):
        np.testing.assert_array_equal(a.log_depth, b.log_depth)
        np.testing.assert_array_equal(a.points.pixels, b.points.pixels)
        assert (a.number, a.sigma, a.rigid, a.cues, a.expected) == (b.number, b.sigma, b.rigid, b.cues, b.expected)
    np.testing.assert_array_equal(before.normal, after.normal)


def test_no_objects_and_bad_files(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=False)
    assert len(load_objects(scene).objects) == 0
    save_objects(scene, SceneObjects([], np.array([0, -1.0, 0])))
    assert len(load_objects(scene).objects) == 0
    for text in ('{"objects": [{}], "normal": [0, 1, 0], "ground": true}', '{"objects": 3}', "{"):
        (scene.folder / "objects.json").write_text(text)
        with pytest.raises(InputError, match=r"objects\.json"):
            load_objects(scene)


def test_objects_of_another_number_of_frames_are_refused(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=False)
    short = DynamicObject(1, np.zeros(3), np.zeros((3, 2)), 0.1, False, {}, ShapePoints.none(), 0.0)
    frames = len(scene.train_frames)
    save_objects(scene, SceneObjects([replace(short, log_depth=np.zeros(frames), middles=np.zeros((frames, 2)))], np.ones(3)))
    assert len(load_objects(scene).objects) == 1
    arrays = dict(np.load(scene.folder / "objects.npz"))
    np.savez(scene.folder / "objects.npz", **{**arrays, "log_depth": arrays["log_depth"][:, :3]})
    with pytest.raises(InputError, match="frames"):
        load_objects(scene)


def test_an_object_without_points_is_an_upright_billboard(scene: Scene):
    frames = len(scene.train_frames)
    middle = np.tile([WIDTH / 2, HEIGHT / 2], (frames, 1))
    obj = DynamicObject(1, np.zeros(frames), middle, 0.1, False, {"contact": Cue(0, 0.1, 0.1)}, ShapePoints.none(), 0.0)
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[10:20, 10:20] = 1
    i = scene.train_frames[0]
    found = SceneObjects([obj], np.array([0, -1.0, 0])).depth(0, mask, scene.frame(i), scene.cameras[i])
    np.testing.assert_allclose(found[mask > 0], 1, atol=0.02)
    assert (found[mask == 0] == 0).all()


def test_shape_offset_follows_sure_points_and_is_flat_without():
    mask = np.zeros((60, 80), bool)
    mask[10:50, 10:70] = True
    image = np.full((60, 80, 3), 128, np.uint8)
    y, x = (value.ravel() for value in np.mgrid[12:50:4, 12:70:4])
    pixels, offsets = np.stack([x, y], 1) + 0.5, 0.05 * (x - 40) / 30
    sure = interpolate_shape_offset(mask, image, pixels, offsets, np.full(len(x), 0.002), 0.05)
    inner = mask & (np.abs(np.arange(80) - 40) < 22)[None]
    columns = np.broadcast_to(np.arange(80), (60, 80))
    assert np.abs(sure[inner] - 0.05 * (columns[inner] + 0.5 - 40) / 30).max() < 0.012
    unsure = interpolate_shape_offset(mask, image, pixels, offsets, np.full(len(x), 1.0), 0.05)
    assert np.abs(unsure).max() < 0.2 * np.abs(sure).max()
    assert (interpolate_shape_offset(mask, image, pixels[:0], offsets[:0], offsets[:0], 0.05) == 0).all()
    assert (interpolate_shape_offset(np.zeros_like(mask), image, pixels, offsets, np.ones(len(x)), 0.05) == 0).all()


def test_objects_go_with_what_they_follow_from(tmp_path: Path):
    scene = write_planes(tmp_path, step=2, square=False)
    save_objects(scene, SceneObjects([], np.array([0, -1.0, 0])))
    scene.finish_prior("objects", method="motion")
    PRIORS.forget(scene, set())
    assert scene.prior("objects") is not None
    PRIORS.forget(scene, {"masks"})
    assert scene.prior("objects") is None
    assert not (scene.folder / "objects.json").exists()
    assert not (scene.folder / "objects.npz").exists()
