"""A tiny clip with truth, and settings that train it in seconds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from flowsplat.output.videos import RenderOptions
from flowsplat.pipeline import run
from flowsplat.pipeline.config import RunConfig
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic

SPEC = SyntheticScene(width=64, height=48, frames=12, fps=6.0)


def small_config(**training) -> RunConfig:
    config = RunConfig()
    train = replace(config.train, iterations=30, checkpoint_every=10, preview_every=10, **training)
    train = replace(train, density=replace(train.density, every=8, start=8))
    return replace(
        config,
        priors=replace(config.priors, priors="true"),
        train=train,
        render=RenderOptions(paths=("input",), width=32),
    )


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("tiny") / "scene"
    write_synthetic(folder, SPEC, holdout=10)
    return folder


@pytest.fixture(scope="session")
def finished(tiny_scene, tmp_path_factory) -> Path:
    """The folder of a whole run of ``small_config``."""
    out = tmp_path_factory.mktemp("finished") / "out"
    run(tiny_scene, out, small_config())
    return out
