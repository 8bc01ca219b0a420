"""Formats with one color a Gaussian get a scene that was fitted to that, once, and nothing else of the run changes."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import flowsplat
from flowsplat.common.errors import InputError
from flowsplat.pipeline import fitting
from flowsplat.scenes import Scene
from flowsplat.training.checkpoint import load_model
from flowsplat.training.config import PRESETS
from flowsplat.training.one_color import FIRST_RATES, ONE_COLOR_FIT_SHARE, one_color_config


@pytest.fixture
def out(finished, tmp_path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "out"))


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def error(model, scene: Scene) -> float:
    images = [
        (model.render(scene.cameras[i], float(scene.timestamps[i])).color, scene.any_frame(i) / 255) for i in scene.train_frames
    ]
    return float(np.mean([np.mean((rendered - image) ** 2) for rendered, image in images]))


def test_the_settings_are_those_of_the_end_of_a_training():
    before = PRESETS["default"]
    config, first = one_color_config(before)
    assert config.iterations - first == ONE_COLOR_FIT_SHARE * before.iterations
    assert first / config.iterations == pytest.approx(FIRST_RATES, abs=1e-3)
    assert before.model.slopes
    assert not config.model.slopes
    assert {config.density.every, config.density.reset_every, config.density.gradient, config.density.revise} == {0}


def test_it_is_fitted_once_and_kept(out, tmp_path, monkeypatch):
    kept = {part: files_of(out / part) for part in ("model", "model_all_frames", "scene", "training", "evaluation", "renders")}
    flowsplat.export(out, "ply", tmp_path / "first.ply")
    fitted, shown = load_model(out / "model_one_color"), flowsplat.load(out)
    assert "slopes" not in fitted.gaussians.params
    assert len(fitted.gaussians) == len(shown.gaussians)
    scene = Scene(out / "scene")
    flat = replace(shown, gaussians=shown.gaussians.without_slopes())
    assert error(fitted, scene) < error(flat, scene)
    assert {part: files_of(out / part) for part in kept} == kept
    assert not list((out / "model_one_color").glob("*step_*")), "its checkpoints are gone"
    monkeypatch.setattr(fitting, "_train_in", lambda *arguments: pytest.fail("it is there"))
    flowsplat.export(out, "ply", tmp_path / "second.ply")
    assert (tmp_path / "second.ply").read_bytes() == (tmp_path / "first.ply").read_bytes()
    flowsplat.export(out, "safetensors", tmp_path / "all.safetensors")


def test_what_is_refused_is_refused_before_it_is_fitted(out, monkeypatch):
    monkeypatch.setattr(fitting, "_train_in", lambda *arguments: pytest.fail("too early"))
    with pytest.raises(InputError, match="outside the clip"):
        flowsplat.export(out, "ply", time=1e3)


def test_where_it_cannot_be_fitted_slopes_are_left_out(out, tmp_path, monkeypatch, capsys):
    def busy(*arguments):
        raise InputError("another process works here.")

    monkeypatch.setattr(fitting, "lease", busy)
    flowsplat.export(out, "ply", tmp_path / "scene.ply")
    told = capsys.readouterr().err
    assert "another process works here" in told
    assert "is left out" in told
    assert (tmp_path / "scene.ply").exists()


def test_another_training_makes_it_anew(out, tmp_path):
    flowsplat.export(out, "ply", tmp_path / "first.ply")
    record = (out / "run.json").read_text()
    assert '"one_color"' in record
    (out / "run.json").write_text(record.replace('"one_color"', '"before"'))
    flowsplat.export(out, "ply", tmp_path / "second.ply")
    assert '"one_color"' in (out / "run.json").read_text()
