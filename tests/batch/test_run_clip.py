"""How a clip is run again for which memory ran short."""

from __future__ import annotations

from dataclasses import replace

from flowsplat.batch.run_clip import fewer_gaussians
from flowsplat.pipeline.config import RunConfig


def test_a_clip_that_ran_out_of_memory_begins_with_half_as_many_gaussians():
    config = RunConfig()
    half = fewer_gaussians(config).train
    assert half.density.max_gaussians == config.train.density.max_gaussians // 2
    assert half.gaussians == 0
    budget = replace(config, train=replace(config.train, gaussians=100_000))
    assert fewer_gaussians(budget).train.most_at_start == budget.train.most_at_start // 2
