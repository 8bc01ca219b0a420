"""Estimates of the time that a run takes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from flowsplat.common.kernels import kernel
from flowsplat.pipeline import speed
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.speed import (
    COMMIT_SECONDS,
    ESTIMATE_FACTOR,
    STAGES,
    UNTRIED_FACTOR,
    Speed,
    TimeEstimate,
    Watch,
    cache_file,
    estimate_seconds,
    self_test,
    stages_of,
)
from flowsplat.training.final import STEPS_A_HELDOUT_FRAME


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FLOWSPLAT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))


@pytest.fixture
def tested(monkeypatch):
    calls = []
    monkeypatch.setattr(speed, "self_test", lambda: calls.append(1) or 3.0)
    return calls


REFERENCE = {"compiling": 0.0, "cameras": 10.0, "priors": 100.0, "train": 400.0, "rest": 50.0}


def test_a_test_comes_first_and_only_once(tested):
    assert Speed("cpu").estimate(REFERENCE) == TimeEstimate(pytest.approx(3 * 560), UNTRIED_FACTOR)
    Speed("cpu").estimate(REFERENCE)
    assert len(tested) == 1
    assert list(json.loads(cache_file().read_text()).values()) == [{"test": [3.0]}]


def test_a_stage_of_this_run_says_more(tested):
    machine = Speed("cpu")
    machine.note(12.0)
    assert machine.estimate(REFERENCE, ["train"]) == TimeEstimate(pytest.approx(6 * 400), ESTIMATE_FACTOR)


def test_after_a_minute_it_commits_itself(tested):
    assert ESTIMATE_FACTOR**2 <= 2, "from when to when it may be: at most twice as long"
    assert Speed("cpu").estimate(REFERENCE, passed=COMMIT_SECONDS).factor == ESTIMATE_FACTOR
    assert Speed("cpu").estimate(REFERENCE, passed=COMMIT_SECONDS - 1).factor == UNTRIED_FACTOR


def test_kernels_that_have_to_be_compiled_take_their_time(tested):
    cold, warm = (Speed("cpu").estimate({**REFERENCE, "compiling": seconds}).expected for seconds in (25.0, 0.0))
    assert cold - warm == pytest.approx(3 * 25)


def test_what_runs_took_is_remembered(tested):
    took = {"ingest": 1.0, "cameras": 12.0, "flow": 30.0, "depth": 169.0, "train": 800.0, "evaluate": 20.0, "render": 4.0}
    assert stages_of(took) == {"cameras": 12.0, "priors": 200.0, "train": 800.0, "rest": 24.0}
    Speed("cpu").remember(took, REFERENCE)
    Speed("cpu").remember({"cameras": 2.0, "flow": 300.0, "train": 1200.0}, REFERENCE)
    machine = Speed("cpu")
    assert machine.factor("cameras") == pytest.approx(1.2), "two seconds tell nothing"
    assert machine.factor("priors") == pytest.approx(2), "nor does a part of the priors"
    assert machine.factor("train") == pytest.approx(2.5)
    assert machine.estimate(REFERENCE, ["train"]).factor == ESTIMATE_FACTOR
    assert tested == []
    for _ in range(9):
        machine.remember({"train": 4000.0}, REFERENCE)
    assert machine.factor("train") == pytest.approx(10), "of the latest runs"


@pytest.mark.parametrize("content", ["", "[1]", '{"cpu, 1 threads": 3}', '{"cpu, 1 threads": {"train": ["x", -1]}}', "\x00"])
def test_a_damaged_file_is_no_error(tested, content):
    cache_file().parent.mkdir()
    cache_file().write_text(content)
    assert Speed("cpu").estimate(REFERENCE).expected > 0


def test_a_folder_that_cannot_be_written_is_no_error(tested, tmp_path):
    (tmp_path / "cache").write_text("in the way")
    assert Speed("cpu").estimate(REFERENCE).expected > 0


CONFIGS = {
    "plain": RunConfig(final_fit=False), "static": RunConfig(baselines="all", final_fit=False), "final": RunConfig(),
}  # fmt: skip


def test_more_work_is_expected_to_take_longer():
    scene = SimpleNamespace(width=640, height=360, num_frames=50, train_frames=range(45), heldout_frames=range(5))
    larger = SimpleNamespace(**{**vars(scene), "width": 1280})
    small, large = (estimate_seconds(each, RunConfig()) for each in (scene, larger))
    assert set(small) == set(STAGES)
    assert all(large[stage] > small[stage] for stage in STAGES[1:])
    rest = {name: estimate_seconds(scene, config)["rest"] for name, config in CONFIGS.items()}
    assert rest["static"] - rest["plain"] == pytest.approx(0.25 * small["train"])
    assert rest["final"] - rest["plain"] == pytest.approx(5 * STEPS_A_HELDOUT_FRAME / RunConfig().train.iterations * small["train"])


def test_a_training_of_no_steps_takes_no_time():
    scene = SimpleNamespace(width=640, height=360, num_frames=50, train_frames=range(45), heldout_frames=range(5))
    config = RunConfig()
    found = estimate_seconds(scene, replace(config, train=replace(config.train, iterations=0)))
    assert found["train"] == 0
    assert found["rest"] == estimate_seconds(scene, CONFIGS["plain"])["rest"]


def test_what_is_true_costs_nothing(tested):
    scene = SimpleNamespace(width=640, height=360, num_frames=50, train_frames=range(45), heldout_frames=range(5))
    config = RunConfig()
    reference = estimate_seconds(scene, replace(config, priors=replace(config.priors, priors="true")))
    assert (reference["cameras"], reference["priors"]) == (0, 0)
    Speed("cpu").remember({"cameras": 20.0, "flow": 30.0, "depth": 30.0, "train": 30.0}, reference)
    assert Speed("cpu").factor("train") == pytest.approx(30 / reference["train"], abs=1e-3)


def test_the_test_itself():
    assert 0.02 < self_test(0.2) < 50


@pytest.mark.parametrize(
    ("seconds", "factor", "words"),
    [
        (0.4, 1.5, "about 10 seconds"), (47, 1.35, "about 50 seconds (30 to 60)"), (61, 1.8, "about 60 seconds (30 to 110)"),
        (100, 1.35, "about 2 minutes (1 to 2)"), (240, 1.35, "about 4 minutes (3 to 5)"), (61, 1.01, "about 60 seconds"),
        (7500, 1.35, "about 2.1 hours (1.5 to 2.8)"),
    ],
)  # fmt: skip
def test_estimates_in_words(seconds, factor, words):
    assert str(TimeEstimate(seconds, factor)) == words


def doubled(values):
    """A kernel."""
    return values * 2


def test_what_compiles_or_shares_the_machine_tells_nothing(monkeypatch):
    used = speed._Used(100.0, 10.0, 0.0)
    monkeypatch.setattr(speed, "_read_used", lambda: used)
    monkeypatch.setattr(speed.os, "cpu_count", lambda: 2)
    watch = Watch()
    used = speed._Used(118.0, 28.0, 10.0)
    assert watch.was_quiet(), "all of it is its own"
    used = speed._Used(138.0, 42.0, 20.0)
    assert not watch.was_quiet(), "six of twenty seconds are not"
    used = speed._Used(140.0, 43.0, 30.0)
    assert watch.was_quiet(), "each question is about the time since the last"
    kernel(doubled)(np.ones(3, np.float32))
    assert not watch.was_quiet()
    assert watch.was_quiet()


def test_a_system_that_tells_nothing_is_believed(monkeypatch):
    monkeypatch.setattr(speed, "_read_used", lambda: None)
    assert Watch().was_quiet()


@pytest.mark.skipif(not Path("/proc/stat").exists(), reason="only Linux tells what others use")
def test_what_this_process_uses_is_part_of_all_that_is_used():
    before = speed._read_used()
    sum(k * k for k in range(3_000_000))
    after = speed._read_used()
    assert after.own - before.own > 0.05
    assert after.all - before.all >= after.own - before.own - 0.1
