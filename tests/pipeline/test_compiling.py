"""Kernels that are compiled ahead: which they are, and when a process is begun for them."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import pytest
from numba.core.dispatcher import Dispatcher

from flowsplat.common.files import write_json
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Similarity
from flowsplat.pipeline import compiling
from flowsplat.pipeline.compiling import (
    Ahead,
    code_state,
    compile_ahead,
    compile_kernel,
    compile_kernels,
    note,
    read_signatures,
)
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


def test_every_kernel_of_the_list_takes_these_arguments():
    listed = read_signatures()
    assert len(listed) == len(set(listed)) > 40
    for name, arguments in listed:
        compile_kernel(name, arguments)


def test_a_list_that_no_longer_fits_stops_nothing(monkeypatch, tmp_path):
    monkeypatch.setattr(compiling, "SIGNATURES", tmp_path / "signatures.json")
    entries = [["splatting.cpu.tiles.no_such", "int64"], ["no.such.module", "int64"], ["splatting.cpu.tiles.prefix_sum", "int64"]]
    write_json(compiling.SIGNATURES, entries)
    compile_kernels()


def test_what_a_training_needs_is_compiled_then():
    compile_kernels()
    before = compiled()
    config = replace(PRESETS["default"], iterations=4, preview_every=0)
    config = replace(config, density=replace(config.density, prune_after=2, prune_change=0.01))
    start = a_few(config)
    observations = seen(start)
    trained = Trainer(observations, None, config, start=start).run()
    model, camera = SceneModel(trained, Similarity(), 0.0, 1.0), observations[0].camera
    model.render(camera, 0.5)
    model.render(camera, 0.0, (observations[1].camera, 0.5))
    assert sum(before.values()) > 10
    assert compiled() == before


RUN = """
import json, sys
from dataclasses import replace
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from flowsplat.pipeline import RunConfig, run
from flowsplat.pipeline.compiling import SIGNATURES, compile_kernel, read_signatures
from flowsplat.common.kernel_cache import KernelCache
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic_video

for name, arguments in read_signatures():
    compile_kernel(name, arguments)

def signatures():
    return {
        (name, attribute, str(signature))
        for name, module in sys.modules.items() if name.startswith("flowsplat.")
        for attribute, value in vars(module).items() if isinstance(value, Dispatcher) and isinstance(value._cache, KernelCache)
        for signature in value.signatures
    }

before = signatures()
clip = Path(sys.argv[1]) / "clip.mp4"
write_synthetic_video(clip, SyntheticScene(width=160, height=90, frames=24))
config = RunConfig()
run(clip, Path(sys.argv[1]) / "out", replace(config, train=replace(config.train, iterations=60)))
print(json.dumps(sorted(signatures() - before)))
"""


@pytest.mark.slow
def test_a_run_compiles_nothing_that_is_not_in_the_list(tmp_path):
    """Where this fails, ``python -m flowsplat_benchmarks.scripts.compiling --write`` makes the list anew."""
    done = subprocess.run([sys.executable, "-c", RUN, str(tmp_path)], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout.splitlines()[-1]) == []


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
    with compile_ahead("cuda") as ahead:
        ahead.wait()
    assert begun == []
    with compile_ahead("cpu") as ahead:
        ahead.wait()
    assert begun == [[sys.executable, "-c", compiling._COMMAND]]
    note(compiling._marker(), code_state("cpu"))
    with compile_ahead("cpu"):
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
