"""Steps of a training grow with the frames of a long clip, and with nothing else."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from flowsplat.training.clip_length import FULL_FRAMES, adapt_to_length
from flowsplat.training.config import PRESETS, RatesConfig, TrainConfig
from flowsplat.training.schedule import LearningRates
from tests.training.handful import a_few, tiny


@pytest.mark.parametrize("frames", [2, 80, FULL_FRAMES])
def test_clips_of_usual_length_train_as_the_settings_say(frames):
    assert adapt_to_length(PRESETS["default"], frames) is PRESETS["default"]


def test_the_paper_and_settings_of_earlier_runs_have_steps_that_no_clip_changes():
    assert adapt_to_length(PRESETS["paper"], 400) == PRESETS["paper"]
    assert adapt_to_length(TrainConfig(), 400) == TrainConfig()


def test_a_long_clip_is_trained_as_finely_in_its_seconds():
    config = PRESETS["default"]
    long = adapt_to_length(config, 3 * FULL_FRAMES)
    assert long.iterations == 3 * config.iterations
    assert (long.density.every, long.density.start) == (3 * config.density.every, 3 * config.density.start)
    assert long.density.prune_after == 3 * config.density.prune_after
    assert (long.model.gains, long.model.knots, long.rates.time_factor) == (3 * config.model.gains, 3 * config.model.knots, 3)
    assert replace(long, iterations=config.iterations, density=config.density, model=config.model, rates=config.rates) == config
    long.check()
    longest = adapt_to_length(replace(config, model=replace(config.model, knots=500)), 10_000)
    assert (longest.model.gains, longest.model.knots) == (256, 1000)
    longest.check()


def test_motion_learns_as_fast_in_seconds():
    """A step of Adam is as large as the rate: it moves the same place by the same length after as many frames."""
    gaussians = a_few(tiny("default"))
    of_short, of_long = (
        LearningRates(replace(RatesConfig(), time_factor=factor), 10, 100.0, torch.device("cpu")).at(0, gaussians, moving=True)
        for factor in (1.0, 3.0)
    )
    for name, rest in (("mean_poly", 3), ("quat_poly", 4)):
        powers = torch.arange(len(of_short[name])) // rest + 1
        tau = 0.1
        torch.testing.assert_close(of_long[name] * (tau / 3) ** powers, of_short[name] * tau**powers)
    torch.testing.assert_close(of_long["times"] * 3, of_short["times"])
    same = of_short.keys() - {"mean_poly", "quat_poly", "times"}
    assert all(torch.equal(of_long[name], of_short[name]) for name in same)
