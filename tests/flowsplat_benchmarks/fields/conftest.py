"""The tiny data root of the runs, a prepared scene, and networks that are trained in seconds."""

from __future__ import annotations

from pathlib import Path

import pytest

from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from flowsplat_benchmarks.fields.networks import FieldConfig
from tests.flowsplat_benchmarks.datasets.conftest import runs_root

__all__ = ["runs_root"]

TINY = FieldConfig(
    width=32, depth=4, point_octaves=4, time_octaves=2, view_octaves=1, deformation_width=16, slicing_width=16, samples=8,
    importance=8, rays=64, chunk=500,
)  # fmt: skip


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory) -> Path:
    """Eight frames of 32x24, one of them held out, with true cameras and depth as their priors, and without held-out views."""
    folder = tmp_path_factory.mktemp("fields") / "scene"
    scene = write_synthetic(folder, SyntheticScene(width=32, height=24, frames=8, fps=6.0), holdout=5)
    truth = scene.truth
    scene.write_cameras(truth.cameras)
    scene.finish_prior("cameras", method="truth")
    for i in scene.train_frames:
        scene.write_depth(i, truth.depth(i))
    (folder / "views.json").rename(folder.parent / "views.json")
    return folder
