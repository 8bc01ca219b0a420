"""Runs that were made before settings were renamed are opened, gone on with, and not computed again.

``data/run_98e47d5.zip`` holds two runs of commit 98e47d5, made with ``prepare``, ``train`` and ``render_run`` of
``flowsplat.pipeline`` on the built-in clip (``write_synthetic``, 48 x 27 pixels, 6 frames, every third held out) with true priors,
12 steps, a checkpoint every 6 steps and ``train.loss.opaque`` 0.2, which is ``train.loss.coverage`` now: ``finished``, and
``stopped``, which was stopped when the checkpoint of step 6 was written. Their scenes are the same and are stored once. Reports,
logs, the preview, evaluated pictures and the truth of the scene were left out, and the path of the input in ``run.json`` was made
relative.
"""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import pytest

import flowsplat
from flowsplat.cli import main
from flowsplat.common.progress import forget_said
from flowsplat.pipeline import run
from flowsplat.pipeline.folder import RunFolder
from flowsplat.training.trainer import Trainer

SETTING = "The setting train.loss.opaque is called train.loss.coverage now."
FIGURE = "The figure open of the history of training is called coverage now."


@pytest.fixture
def earlier(tmp_path) -> Path:
    """A folder with the runs ``finished`` and ``stopped``."""
    with zipfile.ZipFile(Path(__file__).parent / "data" / "run_98e47d5.zip") as archive:
        archive.extractall(tmp_path)
    for name in ("finished", "stopped"):
        shutil.copytree(tmp_path / "scene", tmp_path / name / "scene")
    forget_said()
    return tmp_path


def files_of(out: Path) -> dict[str, bytes]:
    """What is in a run, its settings excepted."""
    files = (path for path in sorted(out.rglob("*")) if path.is_file() and path.name != "run.json")
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in files}


def test_a_finished_run_is_opened(earlier):
    scene, model = flowsplat.Scene(earlier / "finished" / "scene"), flowsplat.load(earlier / "finished")
    rendering = model.render(scene.cameras[1], float(scene.timestamps[1]))
    assert abs(rendering.colour - scene.frame(1) / 255).mean() < 0.2


def test_a_finished_run_is_not_computed_again(earlier, monkeypatch, capsys):
    out = earlier / "finished"
    before, record = files_of(out), json.loads((out / "run.json").read_text())
    monkeypatch.setattr(Trainer, "run", lambda self: pytest.fail("trained again"))
    for command in ("train", "evaluate", "render"):
        main([command, str(out)])
    assert capsys.readouterr().err.count(SETTING) == 1
    run(earlier / "scene", out, RunFolder(out).config)
    assert files_of(out) == before
    after = json.loads((out / "run.json").read_text())
    loss = record["config"]["train"]["loss"]
    loss["coverage"] = loss.pop("opaque")
    assert after == record, "the settings have their present names, and nothing else changed"


def test_options_with_an_earlier_name_are_read(earlier, monkeypatch, capsys):
    out = earlier / "finished"
    monkeypatch.setattr(Trainer, "run", lambda self: pytest.fail("trained again"))
    main(["train", str(out), "--train.loss.opaque", "0.2"])
    main(["train", str(out), "--train.loss.opaque=0.2"])
    assert capsys.readouterr().err.count("--train.loss.opaque is called --train.loss.coverage now.") == 2
    monkeypatch.undo()
    main(["train", str(out), "--train.loss.opaque", "0.3", "--train.iterations", "1"])
    assert "it begins anew" in capsys.readouterr().err
    assert RunFolder(out).config.train.loss.coverage == 0.3


def test_a_stopped_run_goes_on(earlier, capsys, monkeypatch):
    out, steps, iterate = earlier / "stopped", [], Trainer._iterate

    def counted(self):
        steps.append(self.step)
        return iterate(self)

    monkeypatch.setattr(Trainer, "_iterate", counted)
    main(["train", str(out)])
    said = capsys.readouterr().err
    assert steps == [6, 7, 8, 9, 10, 11]
    assert SETTING in said
    assert FIGURE in said
    assert len(flowsplat.load(out).gaussians) == len(flowsplat.load(earlier / "finished").gaussians)
    ours = json.loads((out / "training" / "history.json").read_text())
    expected = json.loads((earlier / "finished" / "training" / "history.json").read_text())
    assert [entry["coverage"] for entry in ours] == pytest.approx([entry["open"] for entry in expected], rel=1e-3)
    assert [entry["loss"] for entry in ours] == pytest.approx([entry["loss"] for entry in expected], rel=1e-3)


def test_the_report_shows_figures_with_an_earlier_name(earlier, capsys):
    out = earlier / "finished"
    main(["render", str(out), "--render.paths", "bullet", "--render.max-frames", "2"])
    assert FIGURE in capsys.readouterr().err
    assert ">coverage<" in (out / "report.html").read_text()
