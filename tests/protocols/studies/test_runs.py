"""The commands on a tiny data root: scenes are prepared once, runs continue, every kind of row trains and measures."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.protocols.studies import ablations, caps, runs, scenes
from flowsplat.protocols.studies.scenes import study_scenes
from tests.protocols.studies.test_reports import result


def call(*arguments: object) -> None:
    main(["benchmark", *(str(argument) for argument in arguments)])


def refuse(capsys, *arguments: object) -> str:
    with pytest.raises(SystemExit) as end:
        call(*arguments)
    assert end.value.code == 2
    return capsys.readouterr().err.strip().splitlines()[-1]


def test_scenes_of_both_kinds(runs_root):
    bear, tiny = study_scenes(runs_root, ["bear", "tiny"], 32)
    assert (bear.name, tiny.name) == ("bear_32", "tiny")
    assert bear.case.config.input.resize == 32
    assert bear.case.variant == "given masks"
    assert tiny.case.config.input.resize is None
    assert tiny.case.config.priors.priors == "true"
    assert [scene.name for scene in study_scenes(runs_root / "rig", ["tiny"], 32)] == ["tiny"]
    with pytest.raises(InputError, match="no scene 'x': choose from bear, plain, tiny"):
        study_scenes(runs_root, ["x"], 32)


@pytest.fixture
def measured(monkeypatch):
    """Stands in for trainings."""
    done = []

    def in_own_process(function, *arguments):
        if function is scenes._prepare:
            return arguments[1]
        run, _ = arguments
        done.append((run.scene.name, run.variant.name, run.config.seed))
        figures = result(run.variant.name, 30.0 + len(done), run.scene.case.scene, run.config.seed)
        return {**figures, "protocol": run.protocol, "cap": run.config.density.max_gaussians, "iterations": run.config.iterations}

    for module in (runs, scenes):
        monkeypatch.setattr(module, "in_own_process", in_own_process)
    return done


def test_ablations_continue(runs_root, tmp_path, measured, capsys):
    arguments = ("ablations", runs_root, "-o", tmp_path, "--scenes", "bear", "tiny", "--rows", "sh-0")
    call(*arguments)
    each = [(scene, variant) for variant in ("full", "sh-0") for scene in ("bear_427", "tiny")]
    assert measured == [(*pair, seed) for seed in (0, 1) for pair in each]
    value = json.loads((tmp_path / "ablations_bear_427_sh-0_seed1.json").read_text())
    assert (value["cap"], value["iterations"]) == (ablations.CAP, ablations.ITERATIONS)
    call(*arguments)
    assert len(measured) == 8
    call(*arguments, "--iterations", "7", "--seeds", "0")
    assert len(measured) == 12
    call(*arguments, "--seeds", "0", "--iterations", "7", "--again")
    assert len(measured) == 16
    assert "colours of degree 0" in (tmp_path / "ablations.md").read_text()
    assert "no row 'x'" in refuse(capsys, "ablations", runs_root, "-o", tmp_path, "--rows", "x")
    assert "no scene 'train'" in refuse(capsys, "ablations", runs_root, "-o", tmp_path)


def test_caps_share_the_point_that_is_in_both_lines(runs_root, tmp_path, measured, capsys):
    call("caps", runs_root, "-o", tmp_path, "--scenes", "bear", "--caps", "100", caps.CAP, "--steps", "50", caps.ITERATIONS)
    assert [variant for _, variant, _ in measured] == ["cap100-steps1500", "cap200000-steps1500", "cap200000-steps50"]
    assert (tmp_path / "caps_cap.svg").exists()
    assert "1 or more" in refuse(capsys, "caps", runs_root, "-o", tmp_path, "--scenes", "bear", "--caps", "0")


@pytest.mark.slow
def test_every_kind_of_row_is_trained(runs_root, tmp_path):
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
    assert "not separable" in text, "one seed on one scene has no spread"
