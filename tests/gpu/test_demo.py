"""A whole run on the GPU is as good as on the CPU."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flowsplat import pipeline
from flowsplat.pipeline.demo import DEMO_ITERATIONS
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic


@pytest.mark.slow
def test_the_demo_trains_to_the_same_figures(tmp_path):
    write_synthetic(tmp_path / "scene", SyntheticScene(width=320, height=180, frames=40), holdout=10)
    start = pipeline.preset("default")
    config = replace(
        start, priors=replace(start.priors, priors="true"), train=replace(start.train, iterations=DEMO_ITERATIONS),
        render=replace(start.render, paths=("input",)),
    )  # fmt: skip
    found = {
        device: pipeline.run(tmp_path / "scene", tmp_path / device, replace(config, device=device)) for device in ("cpu", "cuda")
    }
    for where in ("heldout_frames", "training_frames"):
        cpu, gpu = (found[device][where]["psnr"] for device in ("cpu", "cuda"))
        assert gpu == pytest.approx(cpu, abs=0.2), where
