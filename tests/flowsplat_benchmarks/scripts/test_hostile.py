"""The benchmark that kills runs counts what came of it."""

from __future__ import annotations

import pytest

from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from flowsplat_benchmarks.scripts import hostile


@pytest.mark.slow
def test_one_kill(tmp_path, monkeypatch):
    monkeypatch.setattr(hostile, "SETTINGS", ["--priors", "true", "--train.iterations", "20", "--render.paths", "input"])
    write_synthetic(tmp_path / "scene", SyntheticScene(width=64, height=48, frames=12, fps=6.0), holdout=10)
    found = hostile.kills(tmp_path / "scene", tmp_path, 1)
    assert found["kills"] == 1
    assert found["runs"] == found["runs that ended with the same figures and models, nothing half-written"]
