"""The commands on a tiny data root: scenes are prepared once, runs continue, every kind of row trains and measures."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.scenes import Scene
from flowsplat.training.config import PRESETS
from flowsplat_benchmarks.ablations import benchmark, caps, scenes, training_runs
from flowsplat_benchmarks.ablations.scenes import ablation_scenes, choose_scenes
from tests.flowsplat_benchmarks.ablations.test_reports import result
from tests.output.small import small_model, small_run


def call(*arguments: object) -> None:
    main(["benchmark", *(str(argument) for argument in arguments)])


def refuse(capsys, *arguments: object) -> str:
    with pytest.raises(SystemExit) as end:
        call(*arguments)
    assert end.value.code == 2
    return capsys.readouterr().err.strip().splitlines()[-1]


def test_scenes_of_both_kinds(runs_root):
    known = ablation_scenes(runs_root, 32)
    bear, tiny = choose_scenes(runs_root, known, ["bear", "tiny"])
    assert (bear.name, tiny.name) == ("bear_32", "tiny")
    assert bear.case.config.input.resize == 32
    assert bear.case.variant == "given masks"
    assert tiny.case.config.input.resize is None
    assert tiny.case.config.priors.priors == "true"
    assert ablation_scenes(runs_root, 0)[0].case.config.input.resize == 0, "as it is, not what no wish gives"
    assert [scene.name for scene in ablation_scenes(runs_root / "rig", 32)] == ["tiny"]
    with pytest.raises(InputError, match="no scene 'x': choose from bear, plain, tiny"):
        choose_scenes(runs_root, known, ["x"])


@pytest.fixture
def measured(monkeypatch, in_this_process):
    """Stands in for trainings."""
    done = []

    def measure(run, *_):
        done.append((run.scene.name, run.variant.name, run.config.seed))
        figures = result(run.variant.name, 30.0 + len(done), run.scene.case.scene, run.config.seed)
        cap = run.config.gaussians or run.config.density.max_gaussians
        return {**figures, "protocol": run.protocol, "cap": cap, "iterations": run.config.iterations}

    monkeypatch.setattr(scenes, "prepare_scene", lambda _, folder: folder)
    monkeypatch.setattr(training_runs, "measure", measure)
    return done


def test_ablations_continue(runs_root, tmp_path, measured, capsys):
    arguments = ("ablations", runs_root, "-o", tmp_path, "--scenes", "bear", "tiny", "--rows", "sh-0")
    call(*arguments)
    each = [(scene, variant) for variant in ("full", "sh-0") for scene in ("bear_427", "tiny")]
    assert measured == [(*pair, seed) for seed in (0, 1) for pair in each]
    value = json.loads((tmp_path / "ablations_bear_427_sh-0_1500-steps_seed1.json").read_text())
    assert (value["cap"], value["iterations"]) == (benchmark.MAX_GAUSSIANS, benchmark.ITERATIONS)
    call(*arguments)
    assert len(measured) == 8
    call(*arguments, "--iterations", "7", "--seeds", "0")
    assert len(measured) == 12
    call(*arguments, "--seeds", "0", "--iterations", "7", "--again")
    assert len(measured) == 16
    text = (tmp_path / "ablations.md").read_text()
    assert "Seeds 0; 7 frame-steps." in text
    assert "left out here: 8." in text, "those of other lengths stay, and are not mixed in"
    call(*arguments)
    assert len(measured) == 16
    assert "Seeds 0, 1; 1,500 frame-steps." in (tmp_path / "ablations.md").read_text()
    assert "colors of degree 0" in (tmp_path / "ablations.md").read_text()
    assert "no row 'x'" in refuse(capsys, "ablations", runs_root, "-o", tmp_path, "--rows", "x")
    assert "no scene 'train'" in refuse(capsys, "ablations", runs_root, "-o", tmp_path)


def test_caps_share_the_point_that_is_in_both_lines(runs_root, tmp_path, measured, capsys):
    call(
        "caps",
        runs_root,
        "-o",
        tmp_path,
        "--scenes",
        "bear",
        "--caps",
        "100",
        caps.STEPS_CAP,
        "0",
        "--steps",
        "50",
        caps.ITERATIONS,
    )
    assert [variant for _, variant, _ in measured] == ["cap100", "cap200000", "cap0", "cap200000"]
    assert len(list(tmp_path.glob("caps_bear_854_cap200000_*-steps_seed0.json"))) == 2
    assert "| bear, tuned | free |" in (tmp_path / "caps.md").read_text()
    for name in (*caps.COSTS, "steps"):
        assert (tmp_path / f"caps_{name}.svg").exists()
    for cap in ("-1", caps.FREE_CAP):
        assert "below 1,500,000 (0 = free)" in refuse(capsys, "caps", runs_root, "-o", tmp_path, "--scenes", "bear", "--caps", cap)
    assert "1 or more" in refuse(capsys, "caps", runs_root, "-o", tmp_path, "--scenes", "bear", "--steps", "0")


def test_results_of_other_settings_are_not_compared(runs_root, tmp_path, measured, monkeypatch):
    arguments = ("ablations", runs_root, "-o", tmp_path, "--scenes", "bear", "--rows")
    call(*arguments, "sh-0")
    monkeypatch.setitem(PRESETS, "default", replace(PRESETS["default"], flow_model="affine"))
    call(*arguments, "sh-2")
    text = (tmp_path / "ablations.md").read_text()
    assert len(measured) == 8, "the first row of the table is measured anew"
    assert "colors of degree 2" in text
    assert "colors of degree 0" not in text
    assert "left out here: 2." in text


def test_sizes_are_not_mixed(runs_root, tmp_path, measured):
    arguments = ("caps", runs_root, "-o", tmp_path, "--scenes", "bear", "--caps", "100", caps.STEPS_CAP, "--steps", caps.ITERATIONS)
    call(*arguments, "--size", "32")
    call(*arguments)
    text = (tmp_path / "caps.md").read_text()
    assert "Runs measured: 2." in text
    assert "left out here: 2." in text


def test_what_a_scene_costs_is_measured(tmp_path):
    model = small_model()
    costs = training_runs._size_and_speed(model, Scene(small_run(tmp_path, model) / "scene"))
    assert 10_000 < costs["page_bytes"] < 5_000_000
    assert 0 < costs["image_seconds"] < 5


@pytest.mark.slow
def test_every_kind_of_row_is_trained(runs_root, tmp_path, in_this_process):
    rows = ("4dgs", "static", "per-frame")
    call("ablations", runs_root, "-o", tmp_path, "--scenes", "tiny", "--rows", *rows, "--seeds", "0", "--iterations", "24")
    values = {path.stem.split("_")[2]: json.loads(path.read_text()) for path in tmp_path.glob("*.json")}
    assert set(values) == {"full", *rows}
    for name, value in values.items():
        assert value["test"] == {"kind": "views", "count": 6}, name
        assert 5 < value["psnr"] < 60
        assert value["moving"] > 3
        assert np.isfinite(value["flow_epe"])
        assert 0 < value["gaussians"]["active_mean"] <= value["gaussians"]["total"]
        assert value["seconds"]["train"] > 0
    assert values["full"]["psnr"] > values["4dgs"]["psnr"]
    assert values["full"]["moving"] > values["static"]["moving"]
    assert (tmp_path / "scenes" / "tiny" / "scene" / "scene.json").exists()
    text = (tmp_path / "ablations.md").read_text()
    assert "one static scene" in text
    assert "one run" in text, "one seed on one scene has no spread"
    assert {path.stem for path in (tmp_path / "flow_maps").iterdir()} == {
        f"tiny_{each}" for each in ("frame", "prior", "4dgs", "full")
    } | {"tiny"}
    assert "Flow maps (the paper&#39;s figure): tiny" in (tmp_path / "ablations.html").read_text()
