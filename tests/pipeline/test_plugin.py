"""``examples/plugin`` is installed as a package of somebody else would be, and all that it adds works."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from flowsplat.cli import main
from tests.commands import call_in_one_process

PLUGIN = Path(__file__).parents[2] / "examples" / "plugin"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder that Python finds it in, as pip installs it."""
    folder = tmp_path_factory.mktemp("plugin")
    pip = [sys.executable, "-m", "pip"] if importlib.util.find_spec("pip") else ["uv", "pip"]
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(folder)]
    # Building leaves files beside the sources: a copy has them.
    sources = folder.with_name("sources")
    shutil.copytree(PLUGIN, sources)
    done = subprocess.run([*pip, "install", *options, str(sources)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return folder


def flowsplat(installed: Path, *commands: Sequence[object]) -> list[tuple[int, str, str]]:
    """Commands with the plugin: exit code, stdout and stderr of each."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(installed), os.environ.get("PYTHONPATH", "")])}
    return call_in_one_process(commands, environment=environment)


def without(capsys, *words: object) -> str:
    """What a command is refused with where there is no plugin, as in this process."""
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    assert end.value.code == 2
    told = capsys.readouterr().err
    assert "Traceback" not in told
    return told


def test_the_help_names_what_it_adds(installed):
    ((_, text, _),) = flowsplat(installed, ["train", "--help-all"])
    text = " ".join(text.replace("│", " ").split())
    assert "--train.loss.opaque" in text
    assert "Pixels are covered or not, nothing in between. (0 or more; default: 0.0)" in text
    assert "frozen: Every Gaussian stays as it came." in text
    assert "drift: Everything flies straight on." in text


@pytest.mark.parametrize(("option", "name"), [("--train.strategy", "frozen"), ("--train.model.kind", "drift")])
def test_without_it_its_names_are_refused(finished, tmp_path, capsys, option, name):
    shutil.copytree(finished, tmp_path / "run")
    assert f"invalid choice {name!r}" in without(capsys, "train", tmp_path / "run", option, name)


def test_a_scene_trains_with_its_loss_strategy_and_motion_model(installed, finished, tmp_path, capsys):
    """And its baseline, its camera path and its format are there for the scene that its motion model moves."""
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    options = ("--train.loss.opaque", 0.1, "--train.strategy", "frozen", "--train.model.kind", "drift", "--train.iterations", 20)
    done = flowsplat(
        installed,
        ["train", run, *options],
        ["evaluate", run],
        ["render", run, "--render.paths", "rise", "--render.width", 32, "--render.max-frames", 4],
        ["export", run, "--to", "xyz"],
    )
    assert [code for code, _, _ in done] == [0] * 4, done
    history = json.loads((run / "training" / "history.json").read_text())
    assert all(0 < entry["opaque"] <= 1 for entry in history)
    assert len({entry["gaussians"] for entry in history}) == 1
    assert json.loads((run / "model" / "model.json").read_text())["model"]["kind"] == "drift"
    measured = json.loads((run / "metrics.json").read_text())["baselines"]
    assert 5 < measured["nearest"]["psnr"] <= measured["flow_interpolation"]["psnr"] + 10
    assert (run / "renders" / "rise.mp4").stat().st_size > 500
    rows = [line.split() for line in (run / "export" / "scene.xyz").read_text().splitlines()]
    assert len(rows) > 100
    assert {len(row) for row in rows} == {6}
    assert "opaque" in without(capsys, "info", run)
