"""LPIPS of a run that is finished: it is measured again and not trained, and a wrong file changes nothing."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from flowsplat.cli import main
from flowsplat.evaluation import lpips_network
from flowsplat.training.trainer import Trainer
from tests.evaluation.test_lpips_network import draw_weights


@pytest.fixture
def copy(finished, tmp_path, monkeypatch):
    pytest.importorskip("torchmetrics")
    monkeypatch.setattr(lpips_network, "MIN_SIDE", 32)
    monkeypatch.setattr(Trainer, "run", lambda *_: pytest.fail("trains"))
    return shutil.copytree(finished, tmp_path / "copy")


def test_it_is_added_and_stays(copy, tmp_path):
    torch.save(draw_weights(), tmp_path / "alexnet.pth")
    before, model = (copy / "metrics.json").read_text(), (copy / "model" / "gaussians.safetensors").read_bytes()
    was = json.loads(before)
    assert was["heldout_frames"]["lpips"] is None
    main(["evaluate", str(copy), "--lpips", str(tmp_path / "alexnet.pth")])
    now = json.loads((copy / "metrics.json").read_text())
    assert now["lpips_reason"] is None
    for name in ("heldout_frames", "heldout_frames_refined", "training_frames"):
        assert now[name]["lpips"] > 0, name
        assert now[name]["psnr"] == pytest.approx(was[name]["psnr"], abs=1e-6)
    assert now["baselines"]["copy"]["lpips"] > 0
    assert (copy / "model" / "gaussians.safetensors").read_bytes() == model
    main(["evaluate", str(copy)])
    assert json.loads((copy / "metrics.json").read_text()) == now, "it is finished, and keeps its figures"
    assert f"{now['heldout_frames']['lpips']:.3f}" in (copy / "report.html").read_text()


def read(folder):
    """But the record, which also says when it was written."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "run.json"}


def test_a_wrong_file_changes_nothing(copy, tmp_path, capsys):
    before, stages = read(copy), json.loads((copy / "run.json").read_text())["stages"]
    (tmp_path / "alexnet.pth").write_bytes(b"none")
    with pytest.raises(SystemExit) as end:
        main(["evaluate", str(copy), "--lpips", str(tmp_path / "alexnet.pth")])
    assert end.value.code == 2
    assert "alexnet.pth cannot be read" in capsys.readouterr().err
    assert read(copy) == before
    assert json.loads((copy / "run.json").read_text())["stages"] == stages
