"""``flowsplat.run`` and what it returns, as a person at a Python prompt sees it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import flowsplat
from flowsplat.common.errors import InputError
from flowsplat.pipeline import stages
from flowsplat.pipeline.python_run import make_config


def test_every_public_name_is_listed_and_there():
    assert set(flowsplat.__all__) <= set(dir(flowsplat))
    for name in flowsplat.__all__:
        assert getattr(flowsplat, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'walk'"):
        _ = flowsplat.walk


def test_settings_with_a_short_name_are_taken_by_it():
    config = make_config("default", {"gaussians": 70_000, "--seed": 3})
    assert (config.train.gaussians, config.train.seed) == (70_000, 3)
    assert make_config("default", {"train.gaussians": 70_000}).train.gaussians == 70_000


def test_looking_at_the_names_imports_nothing():
    code = "import sys, flowsplat; dir(flowsplat); print('torch' in sys.modules, 'numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_ipython_completes_the_public_names():
    pytest.importorskip("IPython", reason="completion needs IPython (extra dev)")
    code = """
from IPython.core.interactiveshell import InteractiveShell
shell = InteractiveShell.instance()
shell.run_cell("import flowsplat")
from IPython.core.completer import provisionalcompleter
with provisionalcompleter():
    print(*(each.text for each in shell.Completer.completions("flowsplat.", len("flowsplat."))))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    offered = {name.rpartition(".")[2] for name in done.stdout.split()}
    assert {name for name in flowsplat.__all__ if not name.startswith("_")} <= offered


def test_a_run_has_its_model_scene_and_figures(finished):
    run = flowsplat.Run(finished)
    assert run.folder == Path(finished)
    assert len(run.model.gaussians) == len(flowsplat.load(finished).gaussians)
    assert run.metrics == json.loads((Path(finished) / "metrics.json").read_text(encoding="utf-8"))
    rendering = run.model.render(run.scene.cameras[1], float(run.scene.timestamps[1]))
    assert rendering._repr_png_().startswith(b"\x89PNG")
    said = repr(run)
    assert f"{run.metrics['heldout_frames']['psnr']:.2f} dB" in said
    assert f"{run.scene.num_frames} frames of {run.scene.width}x{run.scene.height}" in said
    shown = run._repr_html_()
    assert "data:image/jpeg;base64," in shown
    assert len(repr(run.model)) < 120
    for value in (run.model, run.scene):
        assert "data:image/jpeg;base64," in value._repr_html_()
    assert repr(run.scene) == f"Scene({str(run.scene.folder)!r}, 12 frames of 64x48, 1 held out, 0 to 1.83 s)"
    assert repr(rendering) == f"Rendering({run.scene.width}x{run.scene.height})"


def test_it_runs_with_the_settings_of_the_command_line(tmp_path, monkeypatch):
    given = []

    def as_if(source, out, config):
        given.append((source, out, config))
        out.mkdir()
        (out / "run.json").write_text("{}")

    monkeypatch.setattr(stages, "run", as_if)
    overrides = {"train.loss.flow": 0.25, "--priors": "true", "final-fit": False, "max_frames": 7, "render.paths": ("input",)}
    run = flowsplat.run("clip.mp4", tmp_path / "<b>", preset="fast", overrides=overrides)
    ((source, out, config),) = given
    assert (source, out, run.folder) == (Path("clip.mp4"), tmp_path / "<b>", tmp_path / "<b>")
    assert (config.train.loss.flow, config.priors.priors, config.final_fit, config.input.max_frames) == (0.25, "true", False, 7)
    assert config.render.paths == ("input",)
    assert config.train.iterations == flowsplat.preset("fast").train.iterations
    assert "&lt;b&gt;" in run._repr_html_()
    assert "not measured yet" in repr(run)


@pytest.mark.parametrize(
    ("preset", "overrides", "message"),
    [
        ("default", {"train.los.flow": 1}, "no setting 'train.los.flow'. Did you mean train.loss.flow"),
        ("default", {"render.fading": True}, "called 'render.confidence-fade' now"),
        ("default", {"train.iterations": "many"}, "iterations"),
        ("best", {}, "Unknown preset 'best'"),
    ],
)
def test_what_cannot_be_set_is_said(preset, overrides, message):
    with pytest.raises(InputError) as error:
        make_config(preset, overrides)
    assert message in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_a_folder_without_a_run_is_said(tmp_path):
    with pytest.raises(InputError, match="is no run"):
        flowsplat.Run(tmp_path)
