"""The GPU benchmark where there is no GPU. How fast anything is, is not tested."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from tests.benchmarks.conftest import BENCHMARKS


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so_in_one_line():
    done = subprocess.run([sys.executable, BENCHMARKS / "gpu.py"], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("There is no GPU to measure: ")
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stdout == ""


def test_its_parts_measure_what_they_say(monkeypatch):
    """On the CPU, where there is no GPU: times mean nothing, but every stage runs and every figure is there."""
    frames = pytest.importorskip("gpu_parts.frames")
    if not torch.cuda.is_available():
        monkeypatch.setattr(frames, "DEVICE", "cpu")
        monkeypatch.setattr(frames, "forget_peak", lambda: None)
        monkeypatch.setattr(frames, "peak_gib", lambda: 1.0)
        monkeypatch.setattr(frames, "milliseconds", lambda job, repeat: (job(), {"min_ms": 1.0, "median_ms": 1.5})[1])
    model = frames.gaussians(300, 40, 24)
    for channels in frames.WAYS:
        picture = frames.Frames(model, 40, 24, channels)
        row = picture.measure({"copy_bytes_per_second": 1e12, "flops_per_second": 1e13}, 1)
        assert picture.features.shape[1] in (channels, channels + 1)
        assert row["pairs"] > 1000
        assert 0 < row["active"] < row["total"] == len(model)
        assert set(row["stages"]) == {"cull", "slice", "project", "features", "blend"}
        peer = picture.compare_with_gsplat(1)
        assert isinstance(peer, str) or peer["ratio"]["forward"] > 0
    monkeypatch.setattr(frames, "TOTAL", 300)
    assert frames.growth((300,), 1)["300"]["active"] > 0


def test_its_page_has_every_row():
    gpu = pytest.importorskip("gpu")
    timing = {"min_ms": 1.0, "median_ms": 1.5}
    frame = {
        "active": 91_000, "forward": timing, "frames_per_second": 667.0, "forward_and_backward": timing, "graph": timing,
        "floor_ms": {"forward": 0.1}, "stages": dict.fromkeys(gpu.STAGES, timing),
    }  # fmt: skip
    memory = {"peak_memory_gib": 1.0}
    page = gpu.lines({
        "machine": {"card": "A card", "torch": "2", "triton": "3"}, "commit": "abc", "date": "today",
        "limits": {"copy_bytes_per_second": 2e12, "flops_per_second": 5e13}, "frames": {"a": frame, "b": frame},
        "gsplat": {"a": "gsplat cannot be imported: no", "b": {"ratio": {"forward": 1.2, "both": 1.1}}},
        "training": {"default": {"step": timing, **memory}},
        "growth": {"5,000,000": {"active": 1, "forward": timing, "forward_and_backward": timing, **memory}},
    })  # fmt: skip
    text = "\n".join(page)
    assert all(word in text for word in ("A card", "2,000 GB/s", "cannot be imported", "1.20 / 1.10", "5,000,000", "default"))
