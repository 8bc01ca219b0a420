import sys
import time
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from flowsplat.evaluation.perceptual import lpips_metric


def fake_torchvision(monkeypatch, folder) -> None:
    """A torchvision that only knows where the weights of AlexNet come from, with torch's cache in ``folder``."""
    models = ModuleType("torchvision.models")
    models.AlexNet_Weights = SimpleNamespace(DEFAULT=SimpleNamespace(url="https://example.org/alexnet-test.pth"))
    monkeypatch.setitem(sys.modules, "torchvision", ModuleType("torchvision"))
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(folder))


class FakeNetwork:
    """Mean difference, after checking what the true network asks of its input."""

    def __init__(self, net_type: str, normalize: bool):
        assert (net_type, normalize) == ("alex", True)
        self.kept = 0

    def __call__(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        assert a.shape == b.shape
        assert a.shape[:2] == (1, 3)
        assert min(a.min(), b.min()) >= 0
        assert max(a.max(), b.max()) <= 1
        self.kept += 1
        time.sleep(0.02)  # for other threads to come between
        assert self.kept == 1, "values of earlier images pile up"
        return (a - b).abs().mean()

    def reset(self) -> None:
        self.kept = 0


def is_a_sentence(reason: str) -> bool:
    return reason.endswith(".") and "\n" not in reason and "LPIPS" in reason


def test_without_torchvision_there_is_a_reason(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchvision", None)
    monkeypatch.setitem(sys.modules, "torchvision.models", None)
    metric, reason = lpips_metric()
    assert metric is None
    assert is_a_sentence(reason)
    assert "pip install -e '.[metrics]'" in reason


def test_without_weights_there_is_a_reason_and_no_download(monkeypatch, tmp_path):
    fake_torchvision(monkeypatch, tmp_path)
    monkeypatch.setattr(torch.hub, "download_url_to_file", lambda *_, **__: pytest.fail("downloads"))
    metric, reason = lpips_metric()
    assert metric is None
    assert is_a_sentence(reason)
    assert "alexnet-test.pth" in reason


def test_damaged_weights_are_a_reason(monkeypatch, tmp_path):
    fake_torchvision(monkeypatch, tmp_path)
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "alexnet-test.pth").write_bytes(b"not weights")

    def broken(**_):
        raise RuntimeError("PytorchStreamReader failed\nand a long story")

    monkeypatch.setattr("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", broken)
    metric, reason = lpips_metric()
    assert metric is None
    assert is_a_sentence(reason)
    assert "long story" not in reason


def test_with_weights_images_are_clipped_and_measured_one_by_one(monkeypatch, tmp_path):
    fake_torchvision(monkeypatch, tmp_path)
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "alexnet-test.pth").write_bytes(b"weights")
    monkeypatch.setattr("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", FakeNetwork)
    metric, reason = lpips_metric()
    assert reason == ""
    white = np.ones((64, 70, 3), np.float32)
    assert metric(white * 1.5, white) == 0
    assert metric(white, white * 0.75) == pytest.approx(0.25)
    assert metric(white[:63], white[:63]) is None


def test_threads_measure_images_one_after_the_other(monkeypatch, tmp_path):
    fake_torchvision(monkeypatch, tmp_path)
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "alexnet-test.pth").write_bytes(b"weights")
    monkeypatch.setattr("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", FakeNetwork)
    metric, _ = lpips_metric()
    white, shares = np.ones((64, 70, 3), np.float32), np.linspace(0, 1, 8).tolist()
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda share: metric(white, white * np.float32(share)), shares))
    np.testing.assert_allclose(found, 1 - np.array(shares), atol=1e-6)
