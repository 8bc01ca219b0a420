"""RAFT with random weights: the true loading code, images of any size, and what is said where it is absent."""

from __future__ import annotations

import sys
from pathlib import Path
from urllib.error import URLError

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.learned.raft import raft_estimator
from flowsplat.priors.learned.weights import ModelOptions
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes import Scene

from ..planes import write_planes
from .conftest import import_torchvision

CPU = torch.device("cpu")


def image(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3)).astype(np.uint8)


@pytest.mark.parametrize("size", [(128, 136), (131, 150), (33, 60)])
def test_images_of_any_size_have_finite_flow(raft_file: Path, size):
    flow = raft_estimator(str(raft_file), CPU)(image(*size), image(*size, seed=1))
    assert flow.shape == (*size, 2)
    assert flow.dtype == np.float32
    assert np.isfinite(flow).all()
    assert np.abs(flow).max() > 0


def test_flow_is_in_pixels_of_the_image(raft_file: Path, monkeypatch):
    from torchvision.models.optical_flow import RAFT

    seen = []

    def forward(self, a, b):
        seen.append((tuple(a.shape), float(a.min()), float(a.max())))
        flow = torch.zeros(1, 2, *a.shape[2:])
        flow[:, 0], flow[:, 1] = 4, 2
        return [flow * 0, flow]

    monkeypatch.setattr(RAFT, "forward", forward)
    flow = raft_estimator(str(raft_file), CPU)(image(64, 100), image(64, 100))
    np.testing.assert_allclose(flow, np.broadcast_to([2.0, 1.0], flow.shape))
    shape, low, high = seen[0]
    assert shape == (1, 3, 128, 200)
    assert -1 <= low < -0.8
    assert 0.8 < high <= 1


def test_a_guess_changes_nothing(raft_file: Path):
    a, b, estimate = image(128, 136), image(128, 136, seed=1), raft_estimator(str(raft_file), CPU)
    np.testing.assert_array_equal(estimate(a, b, np.full((128, 136, 2), 9, np.float32)), estimate(a, b))


def test_the_stage_names_it(raft_file: Path, tmp_path: Path):
    scene = Scene.create(tmp_path, name="s", source="", width=40, height=32, timestamps=range(3), holdout=None, source_fps=1)
    for i in range(3):
        scene.write_frame(i, image(32, 40, seed=i))
    flow_stage(scene, "raft", raft_estimator(str(raft_file), CPU))
    assert scene.prior("flow")["method"] == "raft"
    assert scene.flow_pairs == [(0, 1), (1, 0), (1, 2), (2, 1)]


@pytest.mark.slow
def test_all_flow_is_its_own(raft_file: Path, tmp_path: Path, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("flow of another method")

    monkeypatch.setattr("flowsplat.priors.flow.dis_flow", refuse)
    scene = write_planes(tmp_path, step=2, square=True, holdout=5)
    prepare_priors(scene, PriorsOptions(flow="raft", models=ModelOptions(raft=str(raft_file))))
    assert scene.prior("flow")["method"] == "raft"
    assert all(np.isfinite(scene.depth(i).depth).all() for i in scene.train_frames)


def test_absent_weights_say_where_to_get_them(monkeypatch, tmp_path: Path):
    import_torchvision()

    def offline(*_: object, **__: object) -> None:
        raise URLError("no network")

    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(InputError, match=r"raft_large.*https://download.pytorch.org.*--models.raft FILE.*--flow dis") as caught:
        raft_estimator("large", CPU)
    assert str(tmp_path / "checkpoints") in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [None, b"no weights", {"some": torch.zeros(2)}, [1, 2]])
def test_files_without_its_weights_are_refused(tmp_path: Path, content):
    import_torchvision()
    path = tmp_path / "raft.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(InputError, match=r"--flow raft: .*raft.pth.*--models.raft FILE.*--flow dis") as caught:
        raft_estimator(str(path), CPU)
    assert "\n" not in str(caught.value)


def test_without_torchvision_there_is_a_reason(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torchvision", None)
    with pytest.raises(InputError, match=r"--flow raft needs torchvision.*\.\[learned\].*--flow dis"):
        raft_estimator("large", CPU)
