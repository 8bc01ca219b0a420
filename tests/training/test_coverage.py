"""Surfaces that need not cover their pixels to look right: dark ones before a black background."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from flowsplat.gaussians.observations import Observations
from flowsplat.gaussians.render import FILLED_FROM, render
from flowsplat.training.losses.coverage import UNCOVERED_FROM, coverage_loss
from flowsplat.training.trainer import Trainer
from tests.training.handful import FRAMES, a_few, seen, tiny


def test_only_what_is_less_covered_than_allowed_costs():
    alpha = torch.tensor([[1.0, 0.75, 0.5], [0.0, 0.9, 0.8]], requires_grad=True)
    value = coverage_loss(alpha)
    assert float(value.detach()) == pytest.approx((0.5 - UNCOVERED_FROM + 1 - UNCOVERED_FROM) / 6)
    value.backward()
    np.testing.assert_allclose(alpha.grad, [[0, 0, -1 / 6], [-1 / 6, 0, 0]], rtol=1e-6)
    assert UNCOVERED_FROM < FILLED_FROM, "what is trained to be covered is not filled"


def test_dark_surfaces_become_covered():
    config = tiny("default")
    config = replace(config, iterations=30, rates=replace(config.rates, opacities=0.1))
    dark = a_few(config)
    dark.params["sh"][:] = 0
    dark.params["sh"][:, 0] = -0.5 / 0.2820948  # black
    frames = [replace(frame, image=np.zeros_like(frame.image)) for frame in seen(dark).frames]
    observations = Observations(frames, seen(dark).similarity)

    def left_uncovered(weight: float) -> float:
        start = dark.select(torch.arange(len(dark)))
        trained = Trainer(observations, None, replace(config, loss=replace(config.loss, coverage=weight)), start=start).run()
        shown = (render(trained, frames[k].camera, k / (FRAMES - 1)) for k in range(FRAMES))
        return sum(float(coverage_loss(each.alpha)) for each in shown)

    assert left_uncovered(1.0) < 0.8 * left_uncovered(0.0)
