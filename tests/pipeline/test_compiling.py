"""Kernels that are compiled ahead: which they are, and when a process is begun for them."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import pytest
from numba.core.dispatcher import Dispatcher

from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Similarity
from flowsplat.pipeline import compiling
from flowsplat.pipeline.compiling import Ahead, code_state, compile_training, compiling_ahead, note
from flowsplat.training.config import PRESETS
from flowsplat.training.trainer import Trainer
from tests.training.handful import a_few, seen


def compiled() -> dict[str, int]:
    """How many versions there are of each kernel that Python calls."""
    found = {}
    for name, module in list(sys.modules.items()):
        if name.startswith("flowsplat."):
            for attribute, value in vars(module).items():
                if isinstance(value, Dispatcher):
                    found[f"{name}.{attribute}"] = len(value.signatures)
    return found


def test_what_a_training_needs_is_compiled_then():
    compile_training()
    before = compiled()
    config = replace(PRESETS["default"], iterations=4, preview_every=0)
    start = a_few(config)
    observations = seen(start)
    trained = Trainer(observations, None, config, start=start).run()
    model, camera = SceneModel(trained, Similarity(), 0.0, 1.0), observations[0].camera
    model.render(camera, 0.5)
    model.render(camera, 0.0, (observations[1].camera, 0.5))
    assert sum(before.values()) > 10
    assert compiled() == before


@pytest.fixture
def begun(monkeypatch, tmp_path):
    """The commands of processes that were begun; they end at once."""
    monkeypatch.setenv("FLOWSPLAT_CACHE", str(tmp_path))
    commands, begin = [], subprocess.Popen

    def popen(command, **how):
        commands.append(command)
        return begin([sys.executable, "-c", ""], **how)

    monkeypatch.setattr(compiling.subprocess, "Popen", popen)
    return commands


def test_a_process_is_begun_until_it_is_noted_that_one_ended(begun):
    with compiling_ahead("cuda") as ahead:
        ahead.wait()
    assert begun == []
    with compiling_ahead("cpu") as ahead:
        ahead.wait()
    assert begun == [[sys.executable, "-c", compiling._COMMAND]]
    note(compiling._marker(), code_state("cpu"))
    with compiling_ahead("cpu"):
        pass
    assert len(begun) == 1


def test_what_lies_beside_a_clip_does_not_run(tmp_path):
    for name in ("numba", "flowsplat", "numpy"):
        (tmp_path / f"{name}.py").write_text("open('ran', 'w').close()")
    command = compiling._COMMAND.replace("main()", "print(main)")
    ended = subprocess.run([sys.executable, "-c", command], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "function main" in ended.stdout
    assert not (tmp_path / "ran").exists()


def test_who_no_longer_waits_ends_it():
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    Ahead(process).stop()
    assert process.poll() is not None
