"""The settings and the frames of the final fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowsplat.gaussians.observations import load_observations
from flowsplat.scenes import Flow, Scene
from flowsplat.scenes.layers import Layers
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from flowsplat.training.config import PRESETS
from flowsplat.training.final import (
    FIRST_RATES,
    STEPS_A_HELDOUT_FRAME,
    count_final_steps,
    final_config,
    final_visits,
    with_heldout,
)


@pytest.fixture
def scene(tmp_path) -> Scene:
    write_synthetic(tmp_path / "scene", SyntheticScene(width=48, height=32, frames=7, fps=6.0), holdout=3)
    return Scene(tmp_path / "scene")


@pytest.mark.parametrize("name", ["default", "paper"])
def test_rates_go_on_and_no_gaussian_comes_or_goes(name):
    before = PRESETS[name]
    config, first = final_config(before, 8)
    assert config.iterations - first == 8 * STEPS_A_HELDOUT_FRAME
    assert first / config.iterations == pytest.approx(FIRST_RATES)
    assert (config.rates, config.loss, config.model) == (before.rates, before.loss, before.model)
    assert {config.density.every, config.density.reset_every, config.density.gradient, config.density.revise} == {0}
    assert config.average * config.iterations < config.iterations - first


def test_a_short_training_has_a_short_final_fit():
    short = replace(PRESETS["default"], iterations=40)
    config, first = final_config(short, 8)
    assert config.iterations - first == 10
    assert final_config(short, 1)[0].iterations - final_config(short, 1)[1] == 10
    assert count_final_steps(1, 1) == 1


def test_heldout_frames_are_drawn_as_often_as_all_others_together(scene):
    assert scene.heldout_frames == [2, 5]
    assert final_visits(scene) == [1, 2, 2, 2, 2, 2, 2]


def test_frames_are_in_order_and_flow_leads_to_the_next_one(scene, tmp_path):
    from flowsplat.priors.prepare import use_truth

    use_truth(scene)
    layers = Layers(tmp_path / "priors", scene.width, scene.height)
    for i, j in ((1, 2), (2, 1), (2, 3), (3, 2), (4, 5), (5, 4), (5, 6), (6, 5)):
        layers.write_flow(Flow(i, j, np.full((32, 48, 2), i, np.float32), np.ones((32, 48), np.float32)))
    before = load_observations(scene)
    after = with_heldout(before, scene, layers)
    assert [frame.frame for frame in after.frames] == list(range(7))
    assert [frame.forward.j if frame.forward else None for frame in after.frames] == [1, 2, 3, 4, 5, 6, None]
    assert all(frame.backward is None for frame in after.frames), "nothing starts anew"
    assert (after[1].forward.flow == 1).all()
    assert after[3].forward is before[2].forward, "between training frames it is that of the training"
    np.testing.assert_array_equal(after[2].image, scene.heldout_frame(2))
    assert not after[2].depth_trusted.any()
    assert after[2].time == pytest.approx(scene.times[2])
