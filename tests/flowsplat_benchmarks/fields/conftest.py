"""The tiny data root of the runs, a prepared scene, and networks that are trained in seconds."""

from __future__ import annotations

from pathlib import Path

import pytest

from flowsplat.scenes import Scene
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from flowsplat_benchmarks.fields.networks import FieldConfig
from tests.flowsplat_benchmarks.datasets.conftest import runs_root

__all__ = ["runs_root"]

TINY = FieldConfig(
    width=32, depth=4, point_octaves=4, time_octaves=2, view_octaves=1, deformation_width=16, slicing_width=16, samples=8, importance=8,
    rays=64, chunk=500,
)  # fmt: skip


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory) -> Path:
    """Eight frames of 32x24 with true cameras and depth among the priors, one of them held out."""
    folder = tmp_path_factory.mktemp("fields") / "scene"
    scene = write_synthetic(folder, SyntheticScene(width=32, height=24, frames=8, fps=6.0), holdout=5)
    scene = Scene(folder) if scene is None else scene
    truth = scene.truth
    (folder / "cameras.json").write_bytes((truth.folder / "cameras.json").read_bytes())
    for i in scene.train_frames:
        scene.write_depth(i, truth.depth(i))
    return folder
