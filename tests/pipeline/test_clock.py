"""The clock of the machine is set while a run goes on, by a day or by a year, back or ahead: nothing of it depends on that."""

from __future__ import annotations

import itertools
import json
import threading
import time

import pytest

from flowsplat.common.files import lease
from flowsplat.common.files.lease import NAME, holder
from flowsplat.common.progress import Bar
from flowsplat.pipeline import run, train
from flowsplat.pipeline.folder import RunFolder
from tests.marks import slow
from tests.shared import small_config

DAY, YEAR = 86_400.0, 365 * 86_400.0


SHIFTS = {"day back": -DAY, "day on": DAY, "year back": -YEAR, "year on": YEAR, "before 1970": -80 * YEAR}


@pytest.fixture(params=SHIFTS.values(), ids=SHIFTS)
def set_again_and_again(request, monkeypatch) -> list[float]:
    """Every second look at the clock finds it set; what was seen.

    But for the threads of TensorBoard: one waits in a loop for the time to pass, without a pause where it never does.
    """
    clock, seen = time.time, list[float]()
    shifts = itertools.cycle([0.0, request.param])

    def looked_at() -> float:
        if type(threading.current_thread()).__module__.startswith("tensorboard"):
            return clock()
        seen.append(clock() + next(shifts))
        return seen[-1]

    monkeypatch.setattr(time, "time", looked_at)
    return seen


@pytest.mark.parametrize(
    "set_again_and_again",
    [(pytest.param if name == "year back" else slow)(shift, id=name) for name, shift in SHIFTS.items()],
    indirect=True,
)
def test_a_run_is_the_same(tiny_scene, finished, tmp_path, set_again_and_again):
    began = time.perf_counter()
    run(tiny_scene, tmp_path / "out", small_config())
    took = time.perf_counter() - began
    assert set_again_and_again, "nobody looked at the clock"
    for name in ("model/gaussians.safetensors", "model/model.json", "renders/input_path.mp4"):
        assert (tmp_path / "out" / name).read_bytes() == (finished / name).read_bytes(), name
    seconds = RunFolder(tmp_path / "out").seconds
    assert all(0 <= each <= took for each in seconds.values()), seconds
    assert sum(seconds.values()) <= took + 1
    before = (tmp_path / "out" / "model" / "gaussians.safetensors").stat().st_mtime_ns
    train(RunFolder(tmp_path / "out"))
    assert (tmp_path / "out" / "model" / "gaussians.safetensors").stat().st_mtime_ns == before, "it was finished already"


def test_a_lock_is_held_and_free(tmp_path, set_again_and_again):
    with lease(tmp_path / "out"):
        assert json.loads((tmp_path / "out" / NAME).read_text())["since"] in set_again_and_again
        assert "process " in (holder(tmp_path / "out") or "")
    with lease(tmp_path / "out"):
        pass


def test_the_time_left_does_not_jump(set_again_and_again):
    bar = Bar("Training", 100)
    bar.advance(50)
    assert bar.line == "Training: 50 of 100, 0.0 s left"
