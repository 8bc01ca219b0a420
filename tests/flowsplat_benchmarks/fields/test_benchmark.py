"""``flowsplat benchmark fields`` on a tiny data root: what default took says how long, it continues, and bad input is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from flowsplat_benchmarks.ablations import scenes, training_runs
from flowsplat_benchmarks.fields import benchmark
from flowsplat_benchmarks.fields.report import write_report
from tests.flowsplat_benchmarks.ablations.test_reports import result
from tests.flowsplat_benchmarks.ablations.test_training_runs import call, refuse
from tests.flowsplat_benchmarks.fields.conftest import TINY


def make_result(variant, psnr, seconds, times=1, scene="bear"):
    return {
        **result(variant, psnr, scene), "protocol": "fields", "times": times, "cores": 2, "threads": 2, "inside_ssim": 0.8,
        "parameters": 1_200_000, "image_seconds": 90.0, "seconds": {"train": seconds, "train_cpu": 2 * seconds, "evaluate": 1.0},
    }  # fmt: skip


def test_rows_say_how_long_they_were_trained_and_on_what(tmp_path):
    found = [
        make_result("hypernerf", 19.0, 6111.0, 10), make_result("t-nerf", 18.0, 611.2), make_result("default", 30.0, 610.0),
        {**make_result("t-nerf", 17.0, 60.0, scene="train"), "cores": 1, "threads": 1},
    ]  # fmt: skip
    write_report(tmp_path, found, {"fields_x": "it is torn"}, others=2)
    text = (tmp_path / "fields.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith("|") and "seconds on" in line]
    assert rows[0].startswith("| **Flow Splatting, preset default, 610 seconds on 2 cores** | **1** | **30.00")
    assert rows[1].startswith("| T-NeRF, 611 seconds on 2 cores | 1 | 18.00")
    assert rows[2].startswith("| HyperNeRF, 6,111 seconds on 2 cores | 10 | 19.00")
    assert rows[3].startswith("| T-NeRF, 60 seconds on 1 core | 1 | 17.00")
    assert "fields_x could not be run: it is torn" in text
    assert "left out here: 2" in text
    assert "Runs measured: 0." in write_report(tmp_path, [], {}).read_text()


@pytest.fixture
def on_tiny_scene(tiny_scene, monkeypatch, in_this_process) -> list[str]:
    """A prepared scene in the place of every other one, and a training of default that took a tenth of a second, as is told."""
    done = []

    def prepare(case, folder) -> Path:
        if not folder.exists():
            shutil.copytree(tiny_scene, folder)
        return folder

    def measure(run, path, *_):
        done.append(run.scene.name)
        return make_result(run.variant.name, 30.0, 0.1, scene=run.scene.case.scene)

    monkeypatch.setattr(scenes, "prepare_scene", prepare)
    monkeypatch.setattr(training_runs, "measure", measure)
    monkeypatch.setattr(benchmark, "FieldConfig", lambda: TINY)
    return done


def test_it_trains_and_continues(runs_root, tmp_path, on_tiny_scene, monkeypatch, capsys):
    arguments = ("fields", runs_root, "-o", tmp_path, "--scenes", "bear", "--times", "1", "2")
    call(*arguments)
    assert on_tiny_scene == ["bear_240"]
    values = {path.stem: json.loads(path.read_text()) for path in tmp_path.glob("fields_bear_240_*_times-*.json")}
    assert len(values) == 4
    for name, value in values.items():
        assert value["wanted_seconds"] == pytest.approx(0.1 * value["times"])
        assert value["iterations"] >= 1
        assert value["test"]["count"] >= 1
        assert value["psnr"] > 3, name
        assert value["ssim"] is not None
        assert value["moving"] is not None
        assert value["parameters"] > 1000
    text = (tmp_path / "fields.md").read_text()
    assert len([line for line in text.splitlines() if line.startswith("|") and "seconds on" in line]) == 5
    monkeypatch.setattr(benchmark, "train_field", None)
    call(*arguments)
    assert on_tiny_scene == ["bear_240"], "nothing is measured twice"
    assert "no field 'x': choose from t-nerf, hypernerf" in refuse(capsys, *arguments, "--fields", "x")
    assert "no scene 'x'" in refuse(capsys, "fields", runs_root, "-o", tmp_path, "--scenes", "x")
    for option in (("--times", "0"), ("--seconds", "-1"), ("--seconds", "inf")):
        assert "--times are whole numbers from 1 on" in refuse(capsys, *arguments, *option)


def test_given_seconds_need_no_default_and_again_trains_anew(runs_root, tmp_path, on_tiny_scene, monkeypatch):
    trained = []
    train = benchmark.train_field

    def count(data, plan, folder):
        trained.append((plan.name, plan.seconds, folder.exists()))
        return train(data, plan, folder)

    monkeypatch.setattr(benchmark, "train_field", count)
    arguments = ("fields", runs_root, "-o", tmp_path, "--scenes", "bear", "--times", "3", "--seconds", "0.05", "--fields", "t-nerf")
    call(*arguments)
    assert on_tiny_scene == []
    assert trained == [("t-nerf", pytest.approx(0.15), False)]
    call(*arguments, "--again")
    assert trained[1:] == [("t-nerf", pytest.approx(0.15), False)]


def test_a_default_that_fails_is_told(runs_root, tmp_path, on_tiny_scene, monkeypatch, capsys):
    def fail(run, path):
        raise benchmark.InputError("it is torn")

    monkeypatch.setattr(training_runs, "measure", fail)
    told = refuse(capsys, "fields", runs_root, "-o", tmp_path, "--scenes", "bear", "--times", "1", "--fields", "t-nerf")
    assert "was not measured, and it says how long a field is trained" in told
