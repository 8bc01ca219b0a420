"""The commands: they run, measure, write tables, continue, and go on after a scene that cannot be run."""

from __future__ import annotations

import json
import shutil

import pytest

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.scenes import Scene
from flowsplat_benchmarks.datasets import benchmark, davis_cases
from tests.flowsplat_benchmarks.datasets.conftest import result

QUICK = ("--train.iterations", "6", "--train.checkpoint-every", "3")


def call(*arguments: object) -> None:
    main(["benchmark", *(str(argument) for argument in arguments)])


def refuse(capsys, *arguments: object) -> str:
    with pytest.raises(SystemExit) as end:
        call(*arguments)
    assert end.value.code == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("Error: ")
    return error


@pytest.fixture
def measured(monkeypatch, in_this_process):
    """Stands in for runs: notes the cases, fails on a scene called plain."""
    calls = []

    def measure(case, folder, strip):
        calls.append(case.name)
        if case.scene == "plain":
            raise InputError("no cameras can be found")
        return {**result(case.scene), "name": case.name, "variant": case.variant, "settings": case.settings}

    monkeypatch.setattr(benchmark, "measure_case", measure)
    return calls


def test_one_scene_that_cannot_be_run_does_not_stop_the_others(runs_root, tmp_path, measured, capsys):
    out = tmp_path / "out"
    error = refuse(capsys, "davis", runs_root, "-o", out)
    assert "1 of 2 scenes could not be run, first plain_own-masks_default: no cameras can be found" in error
    assert json.loads((out / "bear_given-masks_default.json").read_text())["ours"]["psnr"] == 31.23
    text = (out / "davis.md").read_text()
    assert "**31.23**" in text
    assert "plain_own-masks_default could not be run" in text
    assert "LPIPS needs its weights." in text
    page = (out / "davis.html").read_text()
    assert "bear, tuned" in page
    assert "Runs measured: 1; that could not be run: 1." in page


def test_what_is_measured_is_kept_until_settings_change(runs_root, tmp_path, measured, capsys):
    arguments = ("davis", runs_root, "-o", tmp_path / "out", "--scenes", "bear")
    call(*arguments)
    call(*arguments)
    assert measured == ["bear_given-masks_default"]
    assert "measured already" in capsys.readouterr().err
    call(*arguments, "--train.iterations", "7")
    assert len(measured) == 2
    call(*arguments, "--masks", "own")
    assert measured[2] == "bear_own-masks_default"
    text = (tmp_path / "out" / "davis.md").read_text()
    assert "flowsplat, given masks, default, iterations 7" in text
    assert "flowsplat, own masks, default" in text
    call(*arguments, "--masks", "own", "--again")
    assert len(measured) == 4


@pytest.mark.parametrize("protocol", ["davis", "rig", "nvidia"])
def test_bad_input_is_one_line(protocol, tmp_path, runs_root, capsys):
    assert "is no folder" in refuse(capsys, protocol, tmp_path / "missing", "-o", tmp_path / "out")
    assert "no scene 'x'" in refuse(capsys, protocol, runs_root, "-o", tmp_path / "out", "--scenes", "x")
    assert "Unknown preset" in refuse(capsys, protocol, runs_root, "-o", tmp_path / "out", "--preset", "best")
    (tmp_path / "file").touch()
    assert "is a file" in refuse(capsys, protocol, runs_root, "-o", tmp_path / "file")
    assert not (tmp_path / "out").exists()


def test_a_damaged_result_is_one_line(runs_root, tmp_path, measured, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "bear_given-masks_default.json").write_text('{"key": ')
    assert "damaged or truncated" in refuse(capsys, "davis", runs_root, "-o", out, "--scenes", "bear")


@pytest.mark.slow
def test_rig_with_true_priors(runs_root, tmp_path):
    out = tmp_path / "out"
    call("rig", runs_root, "-o", out, "--priors", "true", *QUICK)
    value = json.loads((out / "tiny_true-priors_default.json").read_text())
    assert value["test"] == {"kind": "views", "count": 6}
    assert value["settings"] == "default, iterations 6"
    assert set(value["baselines"]) == {"copy", "warp_by_depth", "static"}
    assert all(figures["moving"]["psnr"] > 5 for figures in value["baselines"].values())
    assert value["ours"]["moving"]["psnr"] > 10
    assert value["flow_epe"]["moving"]["mean"] > 0
    assert value["depth_abs_rel"]["static"]["mean"] < 0.1
    assert value["tracks"]["static"]["median"] < 2
    assert value["tracks"]["moving"]["followed"] > 50
    assert {"ingest", "train", "static", "evaluate"} <= set(value["seconds"])
    assert value["peak_memory_gib"] > 0.1
    assert 0 < value["gaussians"]["active_mean"] <= value["gaussians"]["total"]
    assert (out / "rig.html").read_text().count("<img") == 1
    assert (out / "tiny_true-priors_default" / "report.html").exists()


@pytest.mark.slow
def test_davis_with_both_kinds_of_masks(runs_root, tmp_path):
    """Own masks: those of the data set measure, and nothing else sees them."""
    out = tmp_path / "out"
    for masks in ("given", "own"):
        call("davis", runs_root, "-o", out, "--scenes", "bear", "--masks", masks, *QUICK)
        value = json.loads((out / f"bear_{masks}-masks_default.json").read_text())
        assert value["test"] == {"kind": "frames", "count": 1}
        assert value["ours"]["moving"] is not None
        assert value["refined"]["psnr"] >= value["ours"]["psnr"]
        scene = Scene(out / f"bear_{masks}-masks_default" / "scene")
        assert scene.heldout_frames == [9]
        assert (scene.prior("masks") or {})["method"] == ("given" if masks == "given" else "motion")
        assert scene.heldout_masks.has_mask(9)
    text = (out / "davis.md").read_text()
    assert "flowsplat, own masks, default, iterations 6" in text
    assert "| Flow Splatting (the paper) | 31.88 |" in text


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["jumping", "Balloon1", "Raw"])
def test_nvidia(runs_root, tmp_path, scene):
    root = tmp_path / "root"
    shutil.copytree(runs_root / "nvidia" / scene, root / scene)
    call("nvidia", root, "-o", tmp_path / "out", *QUICK)
    (path,) = (tmp_path / "out").glob("*.json")
    value = json.loads(path.read_text())
    assert value["test"]["count"] == {"jumping": 4, "Balloon1": 12, "Raw": 44}[scene]
    assert (value["ours"]["moving"] is None) == (scene != "Raw")
    assert set(value["baselines"]) == {"copy", "static", "warp_by_depth"}
    assert value["baselines"]["warp_by_depth"] is None
    assert value["ours"]["psnr"] > 8
    assert value["verdicts"]["cameras"] == "calibrated cameras, as they came"


def test_cases_of_the_real_data_are_found(data_with_davis):
    cases = {case.scene: case for case in davis_cases(data_with_davis, ["bear", "train"])}
    assert cases["train"].is_tuned
    assert cases["bear"].variant == "given masks"


@pytest.fixture
def data_with_davis():
    import os
    from pathlib import Path

    root = os.environ.get("FLOWSPLAT_DATA")
    if not root:
        pytest.skip("FLOWSPLAT_DATA is not set: the data to measure with is elsewhere")
    return Path(root)
