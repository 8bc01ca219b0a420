"""The benchmark of motion models on a tiny data root: which frames are held out, what is measured, and what tables say of it."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.common.files import lease
from flowsplat.scenes import Scene
from flowsplat_benchmarks.ablations import scenes, training_runs
from flowsplat_benchmarks.ablations.scenes import ablation_scenes
from flowsplat_benchmarks.models import benchmark
from flowsplat_benchmarks.models.lineup import LINEUP, choose_entrants
from flowsplat_benchmarks.models.measure import measure_motion
from flowsplat_benchmarks.models.report import write_report
from flowsplat_benchmarks.models.times import END_LENGTH, GAP_LENGTHS, HELDOUT_SHARE, MIN_FRAMES, list_heldout, place_gaps
from tests.flowsplat_benchmarks.ablations.test_training_runs import call, refuse
from tests.output.small import OTHERS, small_model


@pytest.mark.parametrize("count", [2, 8, 12, 24, 48, 82, 300])
def test_gaps_are_apart_and_leave_most_of_the_clip(count):
    gaps, heldout = place_gaps(count), list_heldout(count)
    assert len(heldout) == sum(map(len, gaps.values()))
    assert len(heldout) <= HELDOUT_SHARE * count
    runs = [0]
    for i in range(count):
        runs = [*runs[:-1], runs[-1] + 1] if i in heldout else [*runs, 0]
    lengths = [length for length in runs if length]
    assert set(lengths) <= {*GAP_LENGTHS, min(END_LENGTH, count // 8)}
    assert 0 not in heldout
    if count >= 48:
        assert {str(length) for length in GAP_LENGTHS} <= gaps.keys()
        assert heldout[-END_LENGTH:] == tuple(range(count - END_LENGTH, count))


def figures(psnr):
    return {"psnr": psnr, "ssim": 0.9, "lpips": None, "count": 3, "moving": {"psnr": psnr - 3, "ssim": 0.8, "lpips": None}}


def result(model, psnr, scene="bear", seed=0, **changes):
    value = {
        "protocol": "models", "scene": scene, "size": [64, 48], "tuned": scene == "bear", "variant": model, "settings": "",
        "seed": seed, "iterations": 1500, "cap": 100_000, "flowsplat": "0", "device": "cpu",
        "test": {"kind": "frames", "count": 3}, "psnr": psnr,
        "ssim": 0.9, "lpips": None, "moving": psnr - 3, "training_psnr": psnr + 2, "flow_epe": None, "flow_prior_epe": 1.0,
        "gaussians": {"total": 1000, "active_mean": 500.0}, "page_bytes": 2_000_000, "image_seconds": 0.02,
        "seconds": {"train": 10.0 if model == "series" else 13.0, "train_cpu": 20.0, "evaluate": 1.0}, "peak_memory_gib": 1.0,
        "times": figures(psnr), "gaps": {"1": figures(psnr + 1), "3": figures(psnr), "5": figures(psnr - 1), "end": None},
        "views": None, "flow": None, "tracks": None, "parameters": {"all": 120_000, "shared": 20_000, "bytes": 480_000},
    }  # fmt: skip
    return {**value, **changes}


def test_the_tables_compare_with_the_series_and_list_every_clip(tmp_path):
    found = [result("series", 30.0, seed=seed) for seed in (0, 1)]
    found += [result("bases", 29.0 + 0.1 * seed, seed=seed) for seed in (0, 1)]
    found += [result("splines", 31.0 + 0.1 * seed, seed=seed) for seed in (0, 1)]
    write_report(tmp_path, found, {"models_x": "it is torn"}, others=2)
    text = (tmp_path / "models.md").read_text()
    assert "2 models beside the series: 1 confirmed, 1 contradicted" in text
    rows = [line for line in text.splitlines() if line.startswith("| bases: Shape of Motion")]
    assert "-0.95 (-0.95)" in rows[0]
    assert "confirmed" in rows[0]
    assert rows[0].rstrip(" |").endswith("1.30")
    assert "| splines: SplineGS | +1.05 (+1.05)" in text
    assert "contradicted" in next(line for line in text.splitlines() if line.startswith("| splines: SplineGS | +1.05"))
    header = next(line for line in text.splitlines() if "gap of 5, inside" in line)
    assert "numbers, million" in header
    assert "from aside" not in header, "nothing of what no run of the clip has"
    assert "none is pruned" in text
    assert "models_x could not be run: it is torn" in text
    assert "left out here: 2" in text
    assert (tmp_path / "models.svg").exists()
    assert "Runs: 6 on the CPU." in text


def test_seconds_are_compared_on_one_device_only(tmp_path):
    found = [result("series", 30.0), result("bases", 29.0)]
    found += [result("series", 30.0, seed=1), result("bases", 29.0, seed=1, device="cuda")]
    found[3]["seconds"]["train"] = 1.0
    write_report(tmp_path, found, {})
    text = (tmp_path / "models.md").read_text()
    assert next(line for line in text.splitlines() if line.startswith("| bases")).rstrip(" |").endswith("1.30")
    assert "Runs: 3 on the CPU, 1 on a CUDA card." in text


def test_what_is_best_where(tmp_path):
    found = [result("series", 30.0), result("bases", 31.0), result("marbles", 29.0)]
    found += [result("series", 30.0, "workshop"), result("bases", 30.01, "workshop")]
    for model, tracks in zip(found, (2.0, 3.0, 1.0, 2.0, 2.5), strict=True):
        model["tracks"] = {"moving": {"median": tracks}}
    write_report(tmp_path, found, {})
    lines = (tmp_path / "models.md").read_text().split("## Which is best where")[1].splitlines()
    header = next(line for line in lines if line.startswith("|")).strip("| ").split(" | ")
    bear, workshop = (
        [cell.strip() for cell in line[1:-1].split("|")][1:] for line in lines if line.startswith(("| bear", "| works"))
    )
    assert bear[0] == "bases (+1.00)"
    assert workshop[0] == "series", "less than what is no difference"
    assert bear[header.index("tracks, %")] == "marbles (-1.00)", "less is better"
    assert bear[header.index("from aside")] == "–"


def test_without_runs_the_page_says_so(tmp_path):
    assert "Nothing is compared yet." in write_report(tmp_path, [], {}).read_text()


@pytest.mark.parametrize("kind", ["series", "bases"])
def test_a_trained_scene_is_measured_by_the_length_of_its_gaps(kind, tmp_path, monkeypatch):
    """With an evaluation that knows its images."""
    model = small_model(OTHERS["bases"]) if kind == "bases" else small_model()
    gaps = place_gaps(40)
    images = [{"kind": "heldout_frame", "frame": i, **figures(20.0 + i)} for i in list_heldout(40)]
    metrics = {
        "per_image": [*images, {"kind": "training_frame", "frame": 0, **figures(50.0)}], "heldout_frames": figures(25.0),
        "heldout_views": None, "flow_epe": {"mean": 1.5, "median": 1.0, "moving": None},
    }  # fmt: skip
    scene = Scene.create(
        tmp_path, name="x", source="x", width=64, height=48, timestamps=range(40), holdout=None, source_fps=1.0,
        heldout=list_heldout(40),
    )  # fmt: skip
    assert scene.heldout_frames == list(list_heldout(40))
    found = measure_motion(model, scene, metrics)
    assert {name: value["count"] for name, value in found["gaps"].items()} == {name: len(frames) for name, frames in gaps.items()}
    assert found["gaps"]["1"]["psnr"] == 20.0 + gaps["1"][0]
    assert found["gaps"]["3"]["moving"]["psnr"] == 17.0 + gaps["3"][1]
    assert found["flow"]["mean"] == 1.5
    assert found["tracks"] is None
    numbers = found["parameters"]
    assert numbers["bytes"] == 4 * numbers["all"]
    assert (numbers["shared"] > 0) == (kind == "bases")


def test_names_are_known():
    assert choose_entrants(()) == list(LINEUP)
    assert [entrant.variant.name for entrant in choose_entrants(["bases"])] == ["series", "bases"]
    with pytest.raises(InputError, match="no model 'x': choose from series, linear, splines"):
        choose_entrants(["x"])


def test_it_continues(runs_root, tmp_path, monkeypatch, in_this_process, capsys):
    done = []

    def measure(run, *_):
        done.append((run.scene.name, run.variant.name, run.config.model.kind, run.config.seed))
        assert run.config.density.max_gaussians == benchmark.MAX_GAUSSIANS
        assert run.measure_more is measure_motion
        return result(run.variant.name, 30.0, run.scene.case.scene, run.config.seed, iterations=run.config.iterations)

    monkeypatch.setattr(scenes, "prepare_scene", lambda _, folder: folder)
    monkeypatch.setattr(training_runs, "measure", measure)
    arguments = ("models", runs_root, "-o", tmp_path, "--scenes", "bear", "--models", "bases", "--seeds", "0")
    call(*arguments)
    assert done == [("bear_427_gaps", "series", "series", 0), ("bear_427_gaps", "bases", "bases", 0)]
    call(*arguments)
    assert len(done) == 2
    call(*arguments[:-4], "--models", "splines", "--seeds", "0")
    assert len(done) == 3
    text = (tmp_path / "models.md").read_text()
    assert "bases: Shape of Motion" in text
    assert "splines: SplineGS" in text
    assert "left out here" not in text
    assert "no model 'x'" in refuse(capsys, "models", runs_root, "-o", tmp_path, "--models", "x")


def test_a_run_can_be_a_command_of_its_own(runs_root, tmp_path, monkeypatch, in_this_process, capsys):
    done = []

    def measure(run, *_):
        done.append((run.variant.name, run.scene.case.config.device))
        return result(run.variant.name, 30.0, run.scene.case.scene, run.config.seed, iterations=run.config.iterations)

    monkeypatch.setattr(scenes, "prepare_scene", lambda _, folder: folder)
    monkeypatch.setattr(training_runs, "measure", measure)
    arguments = ("models", runs_root, "-o", tmp_path, "--scenes", "bear", "--seeds", "0", "--device", "cpu")
    call(*arguments, "--models", "bases", "--no-base")
    assert done == [("bases", "cpu")]
    (tmp_path / "models.md").unlink()
    call("models", runs_root, "-o", tmp_path, "--report-only")
    assert len(done) == 1
    assert "bases: Shape of Motion" in (tmp_path / "models.md").read_text()
    call(*arguments, "--models", "series", "--no-base")
    assert done[1:] == [("series", "cpu")]
    assert "1 models beside the series" in (tmp_path / "models.md").read_text()
    if not torch.cuda.is_available():
        assert "cuda does not work here" in refuse(capsys, *arguments, "--models", "linear", "--device", "cuda")


def test_a_clip_that_is_too_short_for_a_gap_is_refused(runs_root, monkeypatch):
    assert not list_heldout(MIN_FRAMES - 1)
    assert list_heldout(MIN_FRAMES)
    tiny = next(scene for scene in ablation_scenes(runs_root, 32) if scene.case.scene == "tiny")
    options = replace(tiny.case.config.input, max_frames=3)
    short = replace(tiny, case=replace(tiny.case, config=replace(tiny.case.config, input=options)))
    with pytest.raises(InputError, match="tiny has 3 frames, too few to hold any out: take a clip of 4 or more"):
        benchmark.hold_out(short)


def test_a_prepared_scene_is_read_without_a_lock(runs_root, tmp_path):
    tiny = benchmark.hold_out(next(scene for scene in ablation_scenes(runs_root, 32) if scene.case.scene == "tiny"), "cpu")
    path = tiny.prepare(tmp_path)
    with lease(path.parent):
        before = sorted((each, each.stat().st_mtime_ns) for each in tmp_path.rglob("*"))
        assert tiny.prepare(tmp_path) == path
        assert sorted((each, each.stat().st_mtime_ns) for each in tmp_path.rglob("*")) == before


def test_rendered_scenes_hold_out_times_beside_their_cameras(runs_root):
    tiny = next(scene for scene in ablation_scenes(runs_root, 32) if scene.case.scene == "tiny")
    assert benchmark.hold_out(tiny).case.config.input.holdout_frames == list_heldout(12)
    assert benchmark.hold_out(tiny).name == "tiny_gaps"


def test_rendered_scenes_also_come_with_priors_of_our_own(runs_root):
    scenes_by_name = {scene.case.scene: scene for scene in benchmark.list_scenes(runs_root)}
    assert {"bear", "tiny", "tiny-own"} <= scenes_by_name.keys()
    assert "bear-own" not in scenes_by_name
    true, own = (benchmark.hold_out(scenes_by_name[name]) for name in ("tiny", "tiny-own"))
    assert (true.case.config.priors.priors, own.case.config.priors.priors) == ("true", "own")
    assert (own.name, own.case.source) == ("tiny-own_gaps", true.case.source)
    tuned = replace(true.case, scene="workshop"), replace(true.case, scene="workshop-own"), replace(true.case, scene="other-own")
    assert [case.is_tuned for case in tuned] == [True, True, False]


@pytest.mark.slow
def test_every_model_is_trained(runs_root, tmp_path, in_this_process):
    call("models", runs_root, "-o", tmp_path, "--scenes", "tiny", "--seeds", "0", "--iterations", "24")
    values = {path.stem.split("_")[3]: json.loads(path.read_text()) for path in tmp_path.glob("models_*.json")}
    assert set(values) == {entrant.variant.name for entrant in LINEUP}
    for name, value in values.items():
        assert value["times"]["count"] == len(list_heldout(12)), name
        assert value["views"]["count"] == 6
        assert value["times"]["moving"]["psnr"] > 3
        assert value["gaps"]["1"]["psnr"] > 5
        assert value["tracks"]["moving"]["points"] > 0
        assert value["flow"]["moving"]["mean"] >= 0
        assert value["page_bytes"] > 1000
        assert (value["parameters"]["shared"] > 0) == (name in ("bases", "hexplane", "deformation"))
