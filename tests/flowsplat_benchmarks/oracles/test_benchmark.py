"""The command: every oracle is a run that continues, the tables say what each prior costs, and bad input is one line."""

from __future__ import annotations

import json

import pytest

from flowsplat.cli import main
from flowsplat.scenes import Scene
from flowsplat_benchmarks.oracles import benchmark
from flowsplat_benchmarks.oracles.benchmark import oracle_runs
from flowsplat_benchmarks.oracles.classes import CLASSES
from flowsplat_benchmarks.oracles.scenes import ORACLES

QUICK = ("--train.iterations", "6", "--train.checkpoint-every", "3")
PSNR = {"own": (20.0, 14.0), "constant": (22.5, 17.0), "shape_offset": (25.0, 23.0)}


def call(*arguments: object) -> None:
    main(["benchmark", "oracles", *(str(argument) for argument in arguments)])


def refuse(capsys, *arguments: object) -> str:
    with pytest.raises(SystemExit) as end:
        call(*arguments)
    assert end.value.code == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("Error: ")
    return error


def result(run) -> dict:
    """The JSON of a run, without one."""
    psnr, moving = PSNR.get(run.oracle, (26.0, None))
    obj = {
        "matched": {"true": 2, "ids": [1, 3]}, "pixels": 12_345, "frames": 12, "constant": 0.4, "depth_trajectory": None,
        "shape_offset": 0.02,
    }  # fmt: skip
    return {
        "protocol": "oracles", "scene": run.case.scene, "size": [64, 48], "frames": 12, "tuned": run.case.is_tuned,
        "oracle": run.oracle, "settings": run.case.settings, "seed": run.case.config.train.seed,
        "iterations": run.case.config.train.iterations, "flowsplat": "0", "run": run.name, "views": 6, "psnr": psnr, "ssim": 0.9,
        "moving": moving, "covisible": psnr, "training_psnr": 30.0, "mask_iou": 0.9, "scale": 0.5, "static": -0.006,
        "objects": [obj], "gaussians": 1000, "seconds": {"train": 3.0},
        "classes": {"views": ["a"], "pixels": [[10] * len(CLASSES)], "squared": [[10 ** (-psnr / 10)] * len(CLASSES)]},
        "static_classes": [{"pixels": 9, "median": 0.0123, "p90": 0.0456}] * (len(CLASSES) + 1),
    }  # fmt: skip


@pytest.fixture
def measured(monkeypatch, in_this_process):
    """Stands in for preparing and training."""
    done = []

    def measure(run, *_):
        done.append(run.name)
        return result(run)

    monkeypatch.setattr(benchmark, "prepare_scene", lambda _, folder: folder)
    monkeypatch.setattr(benchmark, "measure_oracle", measure)
    return done


def test_which_runs(runs_root):
    runs = list(oracle_runs(runs_root, ["tiny"], []))
    assert [run.oracle for run in runs] == list(ORACLES)
    (flow,) = oracle_runs(runs_root, [], ["flow"])
    assert flow.name == "tiny_flow_default_1600-steps_seed0"
    assert flow.case.config.priors.priors == "own"
    assert flow.case.config.baselines == "simple", "no static scene is trained beside it"


def test_tables(runs_root, tmp_path, measured):
    call(runs_root, "-o", tmp_path, "--oracles", "own", "shape_offset", "constant", "--train.iterations", "7", "--seed", "3")
    assert measured == [f"tiny_{name}_default_7-steps_seed3" for name in ("own", "constant", "shape_offset")]
    text = (tmp_path / "oracles.md").read_text()
    assert "| **own priors as they are** | **20.00 / 14.00** | **–** |" in text
    assert "| *constant*: each object's depth times one number, so that its median over the clip is right | 22.50 / 17.00 |" in text
    assert "| *shape offset*: true depth inside our masks | 25.00 / 23.00 | +2.50 / +6.00 |" in text
    assert "| tiny | 2 | 1, 3 | 12 | 12,345 | +0.400 | – | 0.020 |" in text
    assert "Trained with default, iterations 7, seed 3. Images by held-out cameras: tiny 6." in text
    assert "-0.006 (tiny)" in text
    assert "| tiny | own | share of the error, % | 10.0 | 10.0 |" in text
    assert "| tiny | own | 90th percentile, % | 4.56 | 4.56 |" in text
    page = (tmp_path / "oracles.html").read_text()
    assert "tiny: shape_offset" in page
    assert "*" not in page.split("<main")[-1]


def test_it_continues(runs_root, tmp_path, measured):
    arguments = (runs_root, "-o", tmp_path, "--oracles", "own", "flow")
    call(*arguments)
    call(*arguments, "--workers", "2")
    assert len(measured) == 2
    call(*arguments, "--train.iterations", "7")
    assert len(measured) == 4
    text = (tmp_path / "oracles.md").read_text()
    assert "left out here: 2." in text, "those of other settings stay, and are not mixed in"
    assert "26.00 / –" in text, "objects too small to be measured"
    call(*arguments, "--again", "--workers", "2")
    assert len(measured) == 6


def test_bad_input_is_one_line(runs_root, tmp_path, capsys):
    out = tmp_path / "out"
    assert "is no folder" in refuse(capsys, tmp_path / "missing", "-o", out)
    assert "no scene 'x': choose from tiny" in refuse(capsys, runs_root, "-o", out, "--scenes", "x")
    assert "no oracle 'x': choose from own, constant" in refuse(capsys, runs_root, "-o", out, "--oracles", "x")
    assert "Unknown preset" in refuse(capsys, runs_root, "-o", out, "--preset", "best")
    assert "--train.iterations" in refuse(capsys, runs_root, "-o", out, "--train.iterations", "-1")
    assert "x" in refuse(capsys, runs_root, "-o", out, "--workers", "x")
    assert not out.exists()


@pytest.mark.slow
def test_two_oracles_are_trained_and_kept(runs_root, tmp_path):
    out = tmp_path / "out"
    arguments = (runs_root, "-o", out, "--oracles", "own", "background", "--workers", "2", *QUICK)
    call(*arguments)
    values = {}
    for name in ("own", "background"):
        path = out / f"oracles_tiny_{name}_default_6-steps_seed0.json"
        values[name] = json.loads(path.read_text())
        assert values[name]["views"] == 6
        assert 5 < values[name]["psnr"] < 60
        run = out / f"tiny_{name}_default_6-steps_seed0"
        assert len([view for view in (run / "evaluation" / "views").glob("*.png") if "sheet" not in view.name]) == 6
        assert Scene(run / "scene").info == Scene(out / "scenes" / f"tiny_{name}").info
        path.unlink()
    assert values["own"]["mask_iou"] < 1 == values["background"]["mask_iou"]
    assert values["background"]["scale"] == pytest.approx(values["own"]["scale"])
    assert all(abs(error["constant"]) < 1e-4 for error in values["background"]["objects"])
    models = {path: path.stat().st_mtime_ns for path in out.glob("*/model/*")}
    assert len(models) == 4
    call(*arguments)
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/model/*")} == models, "only the figures were missing"
    for name, value in values.items():
        again = json.loads((out / f"oracles_tiny_{name}_default_6-steps_seed0.json").read_text())
        assert (again["psnr"], again["objects"]) == (value["psnr"], value["objects"])
