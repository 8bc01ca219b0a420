"""Fields on a tiny scene: their gradients, what they are asked for, a few steps, and going on to the bit."""

from __future__ import annotations

import dataclasses
import shutil
import signal

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from flowsplat.common.errors import InputError
from flowsplat.common.stopping import Stopped
from flowsplat.scenes import Scene
from flowsplat_benchmarks.fields import training
from flowsplat_benchmarks.fields.measure import FieldRenderer, score_field
from flowsplat_benchmarks.fields.networks import AMBIENT_START, FieldConfig, HyperNerf, make_field
from flowsplat_benchmarks.fields.rays import cast_rays, find_bounds, load_rays
from flowsplat_benchmarks.fields.training import CHECKPOINT, FieldTrainer, Plan, plan_steps, train_field
from tests.flowsplat_benchmarks.fields.conftest import TINY

BOTH = pytest.mark.parametrize("name", ["t-nerf", "hypernerf"])


def plan(name, seconds=1000.0, key="key"):
    return Plan(name, TINY, 3, seconds, key)


@BOTH
def test_gradients_of_a_field(name):
    config = FieldConfig(
        width=4, depth=3, point_octaves=2, time_octaves=1, view_octaves=1, deformation_octaves=2, slicing_octaves=1,
        deformation_width=4, slicing_width=4, code=2,
    )  # fmt: skip
    field = make_field(name, [0.0, 0.5, 1.0], config, 0).double()
    field.progress = 0.1
    generator = torch.Generator().manual_seed(0)
    names = ["color.weight", "density.weight"]
    names = [f"fine.{each}" for each in names] + (["codes", "screw.weight", "surface.weight"] if name == "hypernerf" else [])
    values = dict(field.named_parameters())
    # Far from zero, where the first weights of a deformation are, so that nothing is at an edge of its rule for small angles.
    chosen = [
        (values[each].detach() + 0.3 * torch.randn(values[each].shape, generator=generator, dtype=torch.float64)).requires_grad_()
        for each in names
    ]
    points = torch.randn((2, 3, 3), generator=generator, dtype=torch.float64).requires_grad_()
    views = torch.nn.functional.normalize(torch.randn((2, 3), generator=generator, dtype=torch.float64), dim=1)
    times = torch.tensor([0.2, 0.9], dtype=torch.float64)

    def ask(points, *chosen):
        return torch.func.functional_call(field, dict(zip(names, chosen, strict=True)), (points, views, times, True))

    assert gradcheck(ask, (points, *chosen))


def test_published_sizes():
    """Eight layers of 256 for each template; six of 128 and of 64 for what moves points."""
    field = make_field("hypernerf", [0.0, 1.0], FieldConfig(), 0)
    assert isinstance(field, HyperNerf)
    assert [layer.out_features for layer in field.fine.trunk.layers] == [256] * 8
    assert field.fine.trunk.layers[4].in_features == 256 + 3 * 17 + 2 * 3
    assert [layer.out_features for layer in field.deformation.layers] == [128] * 6
    assert [layer.out_features for layer in field.slicing.layers] == [64] * 6
    assert 1_000_000 < field.parameter_count < 1_500_000


def test_codes_between_frames_are_mixed_and_ambient_coordinates_wait():
    field = make_field("hypernerf", [0.0, 0.25, 1.0], TINY, 0)
    codes = field.codes.detach()
    mixed = field.mix_codes(torch.tensor([-1.0, 0.0, 0.125, 0.25, 0.625, 2.0])).detach()
    expected = [codes[0], codes[0], (codes[0] + codes[1]) / 2, codes[1], (codes[1] + codes[2]) / 2, codes[2]]
    torch.testing.assert_close(mixed, torch.stack(expected))
    points, times = torch.randn((2, 3, 3), generator=torch.Generator().manual_seed(0)), torch.tensor([0.1, 0.8])
    field.progress = AMBIENT_START / 2
    assert not field.place(points, times)[..., -6:].any()
    field.progress = 1.0
    assert field.place(points, times)[..., -6:].any()


def test_rays_are_those_of_the_cameras_and_meet_the_depth(tiny_scene):
    scene = Scene(tiny_scene)
    data = load_rays(scene)
    assert len(data.rays) == len(data.colors) == len(scene.train_frames) * scene.width * scene.height
    near, far = find_bounds(scene)
    depths = np.stack([scene.depth(i).depth for i in scene.train_frames]) * scene.similarity.scale
    assert near < np.quantile(depths, 0.02)
    assert far > np.quantile(depths, 0.98)
    i = scene.train_frames[-1]
    rays = cast_rays(scene.similarity.camera(scene.cameras[i]), 1.0)
    points = rays.origins + torch.tensor(depths[-1].reshape(-1, 1), dtype=torch.float32) * rays.directions
    pixels, planar = scene.similarity.camera(scene.cameras[i]).project(points.double().numpy())
    np.testing.assert_allclose(planar, depths[-1].ravel(), rtol=1e-4)
    np.testing.assert_allclose(pixels[:2], [[0.5, 0.5], [1.5, 0.5]], atol=1e-2)
    assert data.frame_times == tuple(scene.times[scene.train_frames])


def test_held_out_frames_are_not_looked_at(tiny_scene, monkeypatch):
    def refuse(scene, i):
        raise AssertionError("a held-out frame was read")

    monkeypatch.setattr(Scene, "heldout_frame", refuse)
    scene = Scene(tiny_scene)
    assert scene.heldout_frames
    load_rays(scene)


def test_a_scene_without_depth_is_refused(tmp_path):
    scene = Scene.create(tmp_path, name="x", source="x", width=4, height=4, timestamps=[0, 1], holdout=None, source_fps=1.0)
    with pytest.raises(InputError, match="has no depth: prepare it first"):
        load_rays(scene)


@BOTH
def test_a_few_steps_lower_the_loss(name, tiny_scene):
    trainer = FieldTrainer(load_rays(Scene(tiny_scene)), plan(name), 80)
    losses = []
    for _ in range(80):
        trainer.advance()
        losses.append(trainer.loss)
    assert np.mean(losses[-10:]) < 0.7 * np.mean(losses[:5])


@BOTH
def test_stopped_and_continued_it_has_the_same_bits(name, tiny_scene, tmp_path, monkeypatch):
    data = load_rays(Scene(tiny_scene))
    whole = train_field(data, plan(name), tmp_path / "whole", steps=6)
    advance = FieldTrainer.advance

    def interrupt(trainer):
        advance(trainer)
        if trainer.step == 3:
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(FieldTrainer, "advance", interrupt)
    with pytest.raises(Stopped):
        train_field(data, plan(name), tmp_path / "parts", steps=6)
    monkeypatch.setattr(FieldTrainer, "advance", advance)
    parts = train_field(data, plan(name), tmp_path / "parts", steps=6)
    assert (parts.steps, parts.loss) == (whole.steps, whole.loss) == (6, whole.loss)
    for key, value in whole.field.state_dict().items():
        assert torch.equal(value, parts.field.state_dict()[key]), key
    done = train_field(data, plan(name), tmp_path / "parts", steps=6)
    assert (done.steps, done.seconds) == (6, pytest.approx(parts.seconds, abs=5))
    (tmp_path / "parts" / CHECKPOINT).write_bytes(b"torn")
    with pytest.raises(InputError, match="damaged or truncated"):
        train_field(data, plan(name), tmp_path / "parts", steps=6)


def test_other_settings_begin_anew(tiny_scene, tmp_path):
    data = load_rays(Scene(tiny_scene))
    train_field(data, plan("t-nerf"), tmp_path, steps=4)
    assert train_field(data, plan("t-nerf", key="other"), tmp_path, steps=2).steps == 2


def test_it_ends_with_its_seconds(tiny_scene, tmp_path, monkeypatch):
    data = load_rays(Scene(tiny_scene))
    assert plan_steps(data, plan("t-nerf", 1e-9)) == 1
    monkeypatch.setattr(training, "plan_steps", lambda *_: 1_000_000)
    trained = train_field(data, plan("t-nerf", 0.2), tmp_path)
    assert 1 <= trained.steps < trained.planned
    assert trained.seconds >= 0.2
    assert trained.field.progress < 1


def test_an_image_does_not_depend_on_the_chunks_and_is_scored_once(tiny_scene, tmp_path, monkeypatch):
    scene = Scene(tiny_scene)
    whole, parts = (
        make_field("hypernerf", scene.times[scene.train_frames].tolist(), dataclasses.replace(TINY, chunk=chunk), 0)
        for chunk in (10_000, 100)
    )
    i = scene.heldout_frames[0]
    first, second = (FieldRenderer(field, scene).render(scene.cameras[i], scene.timestamps[i]) for field in (whole, parts))
    np.testing.assert_allclose(first.color, second.color, atol=1e-5)
    np.testing.assert_allclose(first.depth, second.depth, rtol=1e-4)
    assert first.color.shape == (scene.height, scene.width, 3)
    assert first.alpha == pytest.approx(1, abs=1e-4)
    found = score_field(whole, scene, tmp_path / "scores.json", "key")
    assert (found["kind"], found["figures"]["count"]) == ("frames", len(scene.heldout_frames))
    assert found["figures"]["moving"]["psnr"] > 3
    assert 3 < found["figures"]["psnr"] < 60
    assert found["image_seconds"] > 0
    with monkeypatch.context() as patch:
        patch.setattr(FieldRenderer, "render", None)
        assert score_field(whole, scene, tmp_path / "scores.json", "key") == found


def test_views_are_measured_in_the_place_of_frames(tiny_scene, tmp_path):
    shutil.copytree(tiny_scene, tmp_path / "scene")
    shutil.copy(tiny_scene.parent / "views.json", tmp_path / "scene")
    scene = Scene(tmp_path / "scene")
    found = score_field(make_field("t-nerf", [0.0, 1.0], TINY, 0), scene, tmp_path / "scores.json", "key")
    assert (found["kind"], found["figures"]["count"]) == ("views", len(scene.views))
    assert scene.views
