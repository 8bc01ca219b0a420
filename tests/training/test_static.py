"""Scenes to compare with: nothing moves, and together they cost as much as a moving one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.observations import load_observations
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from flowsplat.training.config import PRESETS
from flowsplat.training.per_frame import PerFrameModel, per_frame_config, train_per_frame
from flowsplat.training.static import static_config, static_start

FRAMES = 5


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    folder = tmp_path_factory.mktemp("still") / "scene"
    write_synthetic(folder, SyntheticScene(width=64, height=48, frames=FRAMES, fps=5.0), holdout=None)
    prepare_priors(Scene(folder), PriorsOptions(priors="true"))
    return Scene(folder)


@pytest.fixture(scope="module")
def config():
    default = PRESETS["default"]
    return replace(default, iterations=4 * FRAMES, density=replace(default.density, max_gaussians=400 * FRAMES))


def test_a_static_scene_has_its_objects_once_and_at_rest(scene, config):
    observations = load_observations(scene)
    start = static_start(observations, None, static_config(config))
    assert start.at_rest.all()
    assert len(start) <= config.density.max_gaussians
    moved = start.params["mean_poly"].abs().amax((1, 2)) > 0
    assert moved.any(), "objects are there"
    assert len(torch.unique(start.params["times"][moved])) == 1
    assert static_config(config).loss.flow == static_config(config).loss.rigid == 0


def test_a_random_start_stays_whole(scene, config):
    config = replace(config, init=replace(config.init, from_priors=False, random_count=500))
    start = static_start(load_observations(scene), None, static_config(config))
    assert len(start) == 500
    assert start.at_rest.all()


def test_one_scene_for_every_frame_shares_gaussians_and_steps(scene, config, monkeypatch):
    observations = load_observations(scene)
    share = per_frame_config(config, FRAMES)
    assert share.iterations == 4
    assert share.density.max_gaussians == 400
    sets = train_per_frame(observations, config)
    assert len(sets) == FRAMES
    assert all(0 < len(each) <= 400 for each in sets)
    assert all(each.at_rest.all() for each in sets)
    model = PerFrameModel([SceneModel(each, scene.similarity, 0.0, 0.8) for each in sets], scene.timestamps)
    for i in (0, 3):
        t = float(scene.timestamps[i])
        assert model.nearest(t + 0.09) is model.models[i]
        shown = model.render(scene.cameras[i], t).color
        error = [np.abs(shown - scene.frame(j) / 255).mean() for j in range(FRAMES)]
        assert int(np.argmin(error)) == i, "it looks most like its own frame"
        assert model.active_count(t) == len(sets[i])
