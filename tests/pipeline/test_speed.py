"""Estimates of the time that a run takes."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

from flowsplat.pipeline import speed
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.speed import SHARE, STAGES, Speed, cache_file, expected, in_words, self_test, stages_of


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FLOWSPLAT_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def tested(monkeypatch):
    calls = []
    monkeypatch.setattr(speed, "self_test", lambda: calls.append(1) or 3.0)
    return calls


REFERENCE = {"cameras": 10.0, "priors": 100.0, "train": 400.0, "rest": 50.0}


def test_a_test_comes_first_and_only_once(tested):
    least, most = Speed("cpu").estimate(REFERENCE)
    assert (least, most) == (pytest.approx(0.6 * 3 * 560), pytest.approx(2 * 3 * 560))
    Speed("cpu").estimate(REFERENCE)
    assert len(tested) == 1
    assert list(json.loads(cache_file().read_text()).values()) == [{"test": [3.0]}]


def test_the_cameras_of_this_run_say_more(tested):
    machine = Speed("cpu")
    machine.seen(12.0)
    assert machine.estimate(REFERENCE, ["train"]) == (pytest.approx(0.6 * 6 * 400), pytest.approx(2 * 6 * 400))


def test_what_runs_took_is_remembered(tested):
    took = {"ingest": 1.0, "cameras": 12.0, "flow": 30.0, "depth": 169.0, "train": 800.0, "evaluate": 20.0, "render": 4.0}
    assert stages_of(took) == {"cameras": 12.0, "priors": 200.0, "train": 800.0, "rest": 24.0}
    Speed("cpu").remember(took, REFERENCE)
    Speed("cpu").remember({"cameras": 2.0, "flow": 300.0, "train": 1200.0}, REFERENCE)
    machine = Speed("cpu")
    assert machine.factors("cameras") == (pytest.approx(0.75 * 1.2), pytest.approx(1.25 * 1.2)), "two seconds tell nothing"
    assert machine.factors("priors") == (pytest.approx(0.75 * 2), pytest.approx(1.25 * 2)), "nor does a part of the priors"
    assert machine.factors("train") == (pytest.approx(0.75 * 2), pytest.approx(1.25 * 3))
    assert tested == []
    for _ in range(9):
        machine.remember({"train": 4000.0}, REFERENCE)
    assert machine.factors("train") == (pytest.approx(7.5), pytest.approx(12.5)), "of the latest runs"


@pytest.mark.parametrize("content", ["", "[1]", '{"cpu, 1 threads": 3}', '{"cpu, 1 threads": {"train": ["x", -1]}}', "\x00"])
def test_a_damaged_file_is_no_error(tested, content):
    cache_file().parent.mkdir()
    cache_file().write_text(content)
    assert Speed("cpu").estimate(REFERENCE)[0] > 0


def test_a_folder_that_cannot_be_written_is_no_error(tested, tmp_path):
    (tmp_path / "cache").write_text("in the way")
    assert Speed("cpu").estimate(REFERENCE)[0] > 0


CONFIGS = {
    "plain": RunConfig(final_fit=False), "static": RunConfig(baselines="all", final_fit=False), "final": RunConfig(),
}  # fmt: skip


def test_more_work_is_expected_to_take_longer():
    scene = SimpleNamespace(width=640, height=360, num_frames=50, train_frames=range(45), heldout_frames=range(5))
    larger = SimpleNamespace(**{**vars(scene), "width": 1280})
    small, large = (expected(each, RunConfig()) for each in (scene, larger))
    assert set(small) == set(STAGES)
    assert all(large[stage] > small[stage] for stage in STAGES)
    rest = {name: expected(scene, config)["rest"] for name, config in CONFIGS.items()}
    assert rest["static"] - rest["plain"] == pytest.approx(0.25 * small["train"])
    assert rest["final"] - rest["plain"] == pytest.approx(SHARE * small["train"])


def test_the_test_itself():
    assert 0.02 < self_test(0.2) < 50


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        ((0.2, 0.4), "about 1 second"), ((31, 58), "30 to 60 seconds"), ((61, 185), "1 to 3 minutes"),
        ((100, 119), "about 2 minutes"),
        ((1800, 5900), "30 to 98 minutes"), ((5000, 9000), "1.4 to 2.5 hours"), ((100, 101), "about 2 minutes"),
    ],
)  # fmt: skip
def test_ranges_in_words(seconds, words):
    assert in_words(seconds) == words
