"""Benchmark ``all``: cells are done once at a commit, failures are kept and shown, and pages say what was measured where."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, write_json
from flowsplat_benchmarks.clock import by_the_processor
from flowsplat_benchmarks.oracles import benchmark as oracles
from flowsplat_benchmarks.results import benchmark, jobs
from flowsplat_benchmarks.results.cells import ORACLES, Cell, choose_cells, list_cells
from flowsplat_benchmarks.results.jobs import JOBS, list_missing
from flowsplat_benchmarks.results.pages import format_pages
from flowsplat_benchmarks.results.records import Record, read_record, read_records, write_record
from flowsplat_benchmarks.results.rows import STAGES, Records, compare, tell_whole_run
from tests.flowsplat_benchmarks.ablations.test_training_runs import call, refuse

CELLS = [
    Cell("rig", "tiny", "own", 0, 20.0, "rig"),
    Cell("rig", "tiny", "own", 1, 30.0, "rig"),
    Cell("rig", "gone", "own", 0, 9.0, "rig"),
]


def record(psnr: float | None, commit: str = "aaaaaaa", *, benchmark: str = "davis", scene: str = "bear", variant: str = "given",
           seed: int = 0, failure: str | None = None, **figures: object) -> Record:  # fmt: skip
    ours = {} if psnr is None else {"ours": {"psnr": psnr, "ssim": None, "lpips": None, "moving": {"psnr": psnr - 3}}}
    known = {"protocol": benchmark, "scene": scene, "size": [854, 480], "variant": "given masks", "settings": "default"}
    result = {**known, **ours, **figures} if failure is None else {}
    return Record(benchmark, scene, variant, seed, commit, "two cores", 2, 10.0, failure, result)


def line(page: str, name: str) -> list[str]:
    """The cells of the first row of a page that begins with a name."""
    found = next(each for each in page.splitlines() if each.startswith(f"| {name}"))
    return [cell.strip() for cell in found.strip("|").split(" | ")]


@pytest.fixture
def done(monkeypatch, in_this_process):
    """Stands in for what is measured; ``tiny`` with seed 1 fails."""
    names = []

    def measure(cell, root, work):
        names.append(cell.name)
        if cell.seed:
            raise InputError("it is torn")
        return {"ours": {"psnr": 31.5}}

    monkeypatch.setattr(benchmark, "measure_cell", measure)
    monkeypatch.setattr(benchmark, "list_cells", lambda: CELLS)
    monkeypatch.setattr(benchmark, "describe_commit", lambda: "aaaaaaa")
    return names


def test_a_cell_is_done_once_at_a_commit(data_root, tmp_path, done, monkeypatch, capsys):
    arguments = ("all", data_root, "-o", tmp_path)
    assert "1 of 2 cells could not be run, first rig_tiny_own_seed1: it is torn" in refuse(capsys, *arguments)
    assert done == ["rig_tiny_own_seed0", "rig_tiny_own_seed1"], "what is not in the data root is left out"
    first, second = (json.loads((tmp_path / "cells" / f"{name}.json").read_text()) for name in done)
    assert (first["commit"], first["result"], first["failure"]) == ("aaaaaaa", {"ours": {"psnr": 31.5}}, None)
    assert first["threads"] >= 1
    assert first["seconds"] >= 0
    assert first["machine"]
    assert (second["failure"], second["result"]) == ("it is torn", {})

    call(*arguments)
    assert len(done) == 2, "also what failed is not tried again by itself"
    call(*arguments, "--dry-run")
    told = capsys.readouterr().out
    assert "rig_tiny_own_seed0: done in" in told
    assert "rig_tiny_own_seed1: failed: it is torn" in told
    assert "rig_gone_own_seed0: left out, rig/gone is not in the data root" in told
    refuse(capsys, *arguments, "--retry-failed")
    assert done[2:] == ["rig_tiny_own_seed1"]

    monkeypatch.setattr(benchmark, "describe_commit", lambda: "bbbbbbb")
    call(*arguments, "--seeds", "0")
    assert done[3:] == ["rig_tiny_own_seed0"], "a cell of another commit is measured anew"
    assert "rig_tiny_own_seed1: to do" in "\n".join(benchmark.describe_plan(CELLS[:2], [], tmp_path))


def test_another_machine_goes_on_from_what_is_kept_with_the_pages(data_root, tmp_path, done, capsys, monkeypatch):
    docs = ("--docs", tmp_path / "docs")
    refuse(capsys, "all", data_root, "-o", tmp_path / "here", *docs)
    kept = tmp_path / "docs" / "records" / "rig_tiny_own_seed0.json"
    call("all", data_root, "-o", tmp_path / "there", *docs)
    assert len(done) == 2, "nothing is measured twice, what failed neither"
    call("all", data_root, "-o", tmp_path / "dry", *docs, "--dry-run")
    assert "2 cells, 2 done at aaaaaaa" in capsys.readouterr().out
    assert json.loads((tmp_path / "there" / "cells" / kept.name).read_text())["result"] == {"ours": {"psnr": 31.5}}
    kept.write_text(kept.read_text().replace("aaaaaaa", "ccccccc"))
    call("all", data_root, "-o", tmp_path / "third", *docs, "--seeds", "0")
    assert done[2:] == ["rig_tiny_own_seed0"], "what is kept of another commit is measured"
    monkeypatch.setattr(benchmark, "describe_commit", lambda: "aaaaaaa with changes")
    kept.write_text(kept.read_text().replace("aaaaaaa", "aaaaaaa with changes"))
    call("all", data_root, "-o", tmp_path / "fourth", *docs, "--seeds", "0")
    assert len(done) == 4, "which changes, nobody knows"


@pytest.mark.parametrize("threads", [1, 2])
def test_one_thread_is_timed_by_the_processor(tmp_path, monkeypatch, in_this_process, threads):
    def sleeps(cell, root, work):
        began = time.perf_counter()
        time.sleep(0.2)
        return {"seconds": time.perf_counter() - began}

    clock = time.perf_counter
    monkeypatch.setattr(benchmark, "measure_cell", sleeps)
    monkeypatch.setattr(benchmark.torch, "get_num_threads", lambda: threads)
    found = benchmark._measure(CELLS[0], tmp_path, tmp_path)
    assert (found["result"]["seconds"] >= 0.2) == (threads > 1), "asleep it takes none of the processor"
    assert found["seconds"] >= 0.2, "what the whole took is by the clock: the rest is estimated by it"
    assert ("seconds of the processor" in found["machine"]) == (threads == 1)
    assert time.perf_counter is clock


def test_the_rest_is_estimated_by_what_is_done(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "describe_commit", lambda: "aaaaaaa")
    cells = [Cell("rig", "tiny", "own", seed, seconds) for seed, seconds in ((0, 60.0), (1, 600.0), (2, 60.0))]

    def finish(cell: Cell, seconds: float) -> list[str]:
        job = benchmark.make_measurement(cell, tmp_path, tmp_path)
        assert job.path is not None
        job.path.parent.mkdir(exist_ok=True)
        written = Record("rig", "tiny", "own", cell.seed, "aaaaaaa", "a machine", 1, seconds, None, {})
        job.path.write_text(json.dumps({**written.to_json(), "key": job.key}))
        return benchmark.describe_plan(cells, [], tmp_path)

    told = finish(cells[0], 240.0)
    assert told[2] == "rig_tiny_own_seed2: to do, about 1 min 0 s", "of a short one starting is most"
    told = finish(cells[1], 1080.0)
    assert told[2] == "rig_tiny_own_seed2: to do, about 2 min 0 s"
    assert told[-1] == "3 cells, 2 done at aaaaaaa; the rest takes about 2 min 0 s."


def test_records_are_kept_beside_the_pages(tmp_path):
    write_record(
        tmp_path / "docs" / "records" / "rig_street_own_seed0.json", record(28.0, benchmark="rig", scene="street", variant="own")
    )
    (tmp_path / "out" / "cells").mkdir(parents=True)
    write_record(tmp_path / "out" / "cells" / "davis_bear_given_seed0.json", record(35.2))
    page = benchmark.write_report(tmp_path / "out", tmp_path / "docs")
    assert page == tmp_path / "docs" / "index.md"
    assert len(read_records(tmp_path / "docs" / "records")) == 2
    assert "**35.20 (32.20)**" in page.read_text()
    assert "28.00 (25.00)" in page.read_text()
    elsewhere = benchmark.write_report(tmp_path / "out").read_text()
    assert "35.20" in elsewhere
    assert "](../" not in elsewhere, "these pages stand alone"


def test_a_row_says_where_it_was_measured_and_what_failed():
    found = [
        record(35.0, refined={"psnr": 35.5}), record(36.0, "bbbbbbb"), record(37.0, "bbbbbbb", seed=1),
        record(None, "bbbbbbb", seed=2, failure="out of\nmemory | <really>"), record(None, scene="train", failure="it is torn"),
    ]  # fmt: skip
    page = format_pages(Records(found))["real_clips"]
    cells = line(page, "bear")
    assert cells[1] == "36.50 (33.50)", "the mean of the seeds at the newest commit"
    assert cells[3] == "–", "refined poses of an older commit do not stand beside it"
    assert cells[-1] == "bbbbbbb, 2 seeds; seed 2 failed at bbbbbbb: out of memory \\| &lt;really>"
    assert line(page, "train")[1:] == ["failed", *["–"] * 4, "seed 0 failed at aaaaaaa: it is torn"]
    assert "| camel" not in page
    assert "held out.\n\nNot measured yet: camel, given masks; lucia, given masks; " in page
    assert "- bbbbbbb: two cores, 2 threads" in page
    assert "| **flowsplat** | **36.50 (33.50)** | **not measured** | **failed** |" in format_pages(Records(found))["index"]


def test_a_table_of_which_nothing_is_measured_is_one_line():
    page = format_pages(Records([record(35.0)]))["real_clips"]
    empty = page.split("## At 427 pixels of width\n")[1].split("\n## ")[0]
    assert "|" not in empty
    assert empty.strip().endswith("\n\nNot measured yet: all of it.")


def test_the_orders_are_compared_with_the_papers_and_the_losses_told_in_words():
    def run(variant, psnr):
        result = {"protocol": "ablations", "scene": "bear", "variant": variant, "size": [427, 240], "settings": "default",
                  "seed": 0, "iterations": 1500, "psnr": psnr, "moving": psnr - 2 * (36.8 - psnr)}  # fmt: skip
        return Record("ablations", "bear", variant, 0, "aaaaaaa", "two cores", 2, 10.0, None, result)

    found = [run("full", 36.8), run("orders-6633", 35.78), run("no-velocity", 36.53), run("orders-3333", 36.77)]
    page = format_pages(Records(found))["ablations"]
    assert line(page, "bear, *tuned* ")[1] == "36.80 (36.80)"
    assert line(page, "bear, *tuned*, 6, 6; 3, 3 (the paper's)")[1] == "35.78 (33.74)"
    assert line(page, "3, 3; 3, 3")[1] == "+0.99 (+2.97)", "from the paper's orders, not from all of it"
    assert "together bring 0.27 dB here (0.81 dB inside what moves), and 3.13 dB in the paper." in page
    assert "together bring" not in format_pages(Records([]))["ablations"]


def test_rows_of_worlds_are_told_in_words():
    def sums(median, lost):
        figures = {"objects": 267, "lost": lost, "median": median, "high": None, "idf1": 0.6, "iou": 0.5, "shares": None}
        return Record("objects", "100 worlds", "", 0, "aaaaaaa", "two cores", None, None, None, {"summary": {"own": figures}})

    page = format_pages(Records([sums(0.506, 61)]))["objects"]
    assert "100 worlds: own priors: half of the objects are 66 % too far, 40 % too near, or worse, or not found; 61 of 267" in page
    assert (
        "at least half of the objects are not found (140 of 267 are never found)"
        in format_pages(Records([sums(None, 140)]))["objects"]
    )


def test_the_newest_record_is_the_one_that_ended_last(tmp_path):
    for seed, commit, ended in ((0, "new", 2000.0), (1, "old", 1000.0), (2, "older", None)):
        write_record(tmp_path / f"davis_bear_given_seed{seed}.json", replace(record(30.0 + seed, commit, seed=seed), ended=ended))
    row = Records(read_records(tmp_path)).row("davis", "bear", "given")
    assert row.value("ours", "psnr") == 30.0
    assert row.status() == "new"


def test_what_is_kept_with_the_pages_is_replaced_by_newer_figures_alone(tmp_path):
    kept = tmp_path / "docs" / "records" / "davis_bear_given_seed0.json"
    kept.parent.mkdir(parents=True)
    written = tmp_path / "out" / "cells" / kept.name
    written.parent.mkdir(parents=True)
    here = replace(record(34.0), ended=2000.0)
    write_record(kept, here)
    for found, after in (
        (replace(record(33.0, "bbbbbbb"), ended=1000.0), here),
        (replace(record(None, failure="no space"), ended=3000.0), here),
        (replace(record(35.0, "bbbbbbb"), ended=3000.0), replace(record(35.0, "bbbbbbb"), ended=3000.0)),
        (failed := replace(record(None, "ccccccc", failure="no space"), ended=4000.0), failed),
    ):
        write_record(written, found)
        benchmark.write_report(tmp_path / "out", tmp_path / "docs")
        assert read_record(kept) == after


def test_motions_compare_in_rows_of_their_own():
    def run(variant, psnr):
        result = {"protocol": "models", "scene": "bear", "variant": variant, "size": [427, 240], "settings": "default", "seed": 0,
                  "iterations": 1500, "times": {"psnr": psnr}}  # fmt: skip
        return Record("models", "bear", variant, 0, "aaaaaaa", "two cores", 2, 10.0, None, result)

    page = format_pages(Records([record(35.0), run("series", 33.19), run("bases", 31.77)]))["paper"]
    table = page.split("## Table 2")[1].split("\n## ")[0]
    assert line(table, "Shape of Motion, motion alone")[1] == "31.77"
    assert line(table, "Flow Splatting, motion alone")[1] == "33.19"
    assert line(table, "**Flow Splatting, ours**")[1] == "**35.00**"
    assert "Not measured yet: Deformable 3DGS, motion alone; 4D Gaussians, motion alone; DG Marbles, motion alone.\n" in table


def test_without_records_nothing_is_said_to_be_measured():
    for name, page in format_pages(Records([])).items():
        assert "not measured" in page.lower(), name
        assert len(page.encode()) < 8192, name


def test_differences_are_of_one_commit():
    def run(variant, psnr, commit, seed=0):
        result = {"psnr": psnr, "moving": psnr - 3}
        return Record("ablations", "bear", variant, seed, commit, "two cores", 2, 10.0, None, result)

    found = [run("full", 34.0, "aaaaaaa"), run("no-q", 33.0, "aaaaaaa"), run("full", 36.0, "bbbbbbb")]
    effect, row = compare(Records(found), "ablations", ["bear"], ("no-q", "full"), ("psnr",))
    assert effect is not None
    assert (effect.mean, row.status()) == (-1.0, "aaaaaaa"), "the newer base has no such row beside it"
    effect, row = compare(Records([*found, run("no-q", 35.5, "bbbbbbb")]), "ablations", ["bear"], ("no-q", "full"), ("psnr",))
    assert effect is not None
    assert (effect.mean, row.status()) == (-0.5, "bbbbbbb")
    elsewhere = [replace(each, scene="train") for each in found[:2]]
    both = Records([*elsewhere, *found, run("no-q", 35.5, "bbbbbbb")])
    effect, row = compare(both, "ablations", ["bear", "train"], ("no-q", "full"), ("psnr",))
    assert effect is not None
    assert (effect.mean, row.status()) == (-0.5, "bbbbbbb"), "no mean over two commits"


def test_bad_records_are_a_line(data_root, tmp_path, capsys):
    cells = tmp_path / "cells"
    cells.mkdir()

    def told(text: str) -> str:
        (cells / "a.json").write_text(text)
        return refuse(capsys, "all", data_root, "-o", tmp_path, "--report-only")

    good = record(35.0).to_json()
    assert "a.json is not readable JSON" in told("{")
    assert "a.json is damaged" in told(json.dumps({**good, "seed": "x"}))
    assert "is of version 99" in told(json.dumps({**good, "version": 99}))
    assert "ours.psnr is no number" in told(json.dumps({**good, "result": {"ours": {"psnr": "many"}}}))
    assert "lacks figures of its objects" in told(json.dumps({**good, "benchmark": "objects", "scene": "plain-900"}))
    assert "a.json is damaged" in told(json.dumps([good, 3]))
    assert not (tmp_path / "pages").exists()


def test_the_plan():
    cells = list_cells()
    assert len({cell.name for cell in cells}) == len(cells)
    assert [cell.seconds for cell in cells] == sorted(cell.seconds for cell in cells)
    assert sum(cell.seconds for cell in cells) < 12 * 3600, "a night"
    assert {cell.benchmark for cell in cells} == set(JOBS)
    assert [cell.name for cell in choose_cells(cells, ["fields"], [])] == [
        "fields_bear_t-nerf_seed0",
        "fields_bear_hypernerf_seed0",
        "fields_bear_t-nerf-10-times_seed0",
        "fields_bear_hypernerf-10-times_seed0",
    ]
    assert {cell.seed for cell in choose_cells(cells, ["rig"], [1])} == {1}
    with pytest.raises(InputError, match="--only nothing: no benchmark, scene or cell is called so"):
        choose_cells(cells, ["nothing"], [])
    with pytest.raises(InputError, match="--seeds 7"):
        choose_cells(cells, [], [7])
    with pytest.raises(InputError, match="is no folder"):
        list_missing(Path("/missing"), cells)


def test_each_benchmark_is_asked_for_its_part(data_root, tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(jobs, "measure_case", lambda case, folder, strip: asked.update(case=case, folder=folder) or {})
    jobs.measure_cell(Cell("davis", "clip", "own-427", 3, 1.0), data_root, tmp_path)
    case = asked["case"]
    assert (case.variant, case.config.train.seed, case.config.input.resize) == ("own masks", 3, 427)
    assert case.lent is not None
    assert case.lent[1].resize == 427, "masks that only measure are as large as the images"
    jobs.measure_cell(Cell("rig", "tiny", "true", 0, 1.0), data_root, tmp_path)
    assert (asked["case"].variant, asked["folder"]) == ("true priors", tmp_path / "rig_tiny_true_seed0")

    runs = []
    monkeypatch.setattr(jobs.TrainingRun, "_measure", lambda run, out: runs.append(run) or {})
    for benchmark_name, variant in (("ablations", "no-mu"), ("caps", "50000"), ("caps", "free"), ("caps", "400-steps")):
        jobs.measure_cell(Cell(benchmark_name, "clip", variant, 1, 1.0), data_root, tmp_path)
    assert [run.scene.name for run in runs] == ["clip_427"] * 4
    assert [(run.config.iterations, run.config.gaussians) for run in runs[1:]] == [(1600, 50_000), (1600, 0), (400, 200_000)]
    assert (runs[0].config.seed, runs[0].config.model.move_means) == (1, False)


def test_the_other_benchmarks_are_asked_for_their_part(data_root, tmp_path, monkeypatch):
    def do(*cell: str | int) -> object:
        return jobs.measure_cell(Cell(*cell, 1.0), data_root, tmp_path)  # type: ignore[arg-type]

    monkeypatch.setattr(jobs.priors, "measure_scene", lambda scene, folder: (scene.kind, scene.name, folder.name))
    assert do("priors", "pair", "", 0) == ("pair", "pair", "priors_pair_seed0")
    monkeypatch.setattr(jobs.objects, "measure_world", lambda world, *_, kind, again: (world, kind, again))
    assert do("objects", "plain-904", "", 0) == (904, "any", False)
    assert do("objects", "dancers-900", "", 0) == (900, "dancers", False)
    monkeypatch.setattr(oracles.OracleRun, "_measure", lambda run, out: (run.oracle, run.case.config.train.iterations))
    assert [do("oracles", "tiny", oracle, 0) for oracle in ORACLES] == [(oracle, 1000) for oracle in ORACLES]
    monkeypatch.setattr(
        jobs.TrainingRun, "_measure", lambda run, _: (run.scene.name, run.variant.name, run.config.seed, run.measure_more)
    )
    assert do("models", "clip", "splines", 1) == ("clip_427_gaps", "splines", 1, jobs.measure_motion)
    assert do("models", "tiny-own", "series", 0)[:2] == ("tiny-own_gaps", "series")
    monkeypatch.setattr(jobs.growth, "enlarge", lambda _, side, path: path)
    monkeypatch.setattr(
        jobs.growth, "measure", lambda case: {"case": (case.kind, case.frames, case.side), "clip": "/home", "out": "/"}
    )
    assert do("growth", "frames-200", "", 0) == {"case": ("frames", 200, 320)}, "no folder of a machine is kept"
    assert do("growth", "pixels-640", "", 0) == {"case": ("pixels", 16, 640)}


def test_a_field_is_trained_as_long_as_default(data_root, tmp_path, monkeypatch):
    trained = []
    monkeypatch.setattr(jobs.TrainingRun, "_measure", lambda run, out: trained.append(run.protocol) or {"seconds": {"train": 9.0}})
    monkeypatch.setattr(
        jobs.fields, "measure", lambda run, out: {"field": run.field, "budget": run.times * jobs.fields._read_seconds(run, out)}
    )
    for variant, seconds in (("t-nerf", 9.0), ("t-nerf", 9.0), ("t-nerf-10-times", 90.0)):
        found = jobs.measure_cell(Cell("fields", "clip", variant, 0, 1.0), data_root, tmp_path)
        assert (found["field"], found["budget"], found["default"]["seconds"]) == ("t-nerf", seconds, {"train": 9.0})
    assert trained == ["fields"], "default is trained once"


@pytest.mark.parametrize("is_counted", [True, False])
def test_the_demo_takes_what_its_process_does(tmp_path, monkeypatch, is_counted):
    """By the processor its own seconds count, by the clock those that it was waited for."""

    def work(command, **_):
        folder = Path(command[-1]) / "own"
        assert not folder.exists(), "what was made before would be gone on with"
        make_folder(folder)
        subprocess.run([sys.executable, "-c", "import time\nwhile time.process_time() < 0.6: pass"], check=True)
        write_json(folder / "metrics.json", {"peak_memory_gib": 1.5})
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(jobs, "subprocess", SimpleNamespace(run=work))
    make_folder(tmp_path / "demo_street_seed0" / "own")
    with by_the_processor() if is_counted else nullcontext():
        found = jobs.measure_cell(Cell("demo", "street", "", 0, 1.0), tmp_path, tmp_path)
    assert 0.5 < found["seconds"]["whole"] < 30
    assert found["peak_memory_gib"] == 1.5


def complete(cell: Cell) -> Record:
    """A record of a cell with every figure that a page shows."""
    image = {"psnr": 33.333, "ssim": 0.9555, "lpips": 0.0999, "moving": {"psnr": 31.111, "median": 1.5, "last": 2.5, "mean": 0.77}}
    whole = {**image, "covisible": image, "static": {"median": 0.01}, "mean": 0.55}
    figures = dict.fromkeys(
        ("ours", "refined", "training_frames", "times", "views", "flow_epe", "prior_flow_epe", "depth_abs_rel"), whole
    )
    seconds = dict.fromkeys(("cameras", "flow", "masks", "tracks", "depth", "train", "evaluate", "whole"), 123.4)
    keys = ("flow.epe", "flow.epe_objects", "flow.kept", "flow.right", "cameras.path", "cameras.rotation", "cameras.focal")
    more = ("depth.static", "depth.objects", "masks.iou", "tracks.life", "tracks.within", "time.total", "time.memory")
    one = {"ln_distance": 0.1, "sigma": 0.2, "depth_trajectory": 0.1, "shape_offset": 0.1, "idf1": 0.5, "iou": 0.5}
    result = {
        "protocol": cell.benchmark, "scene": cell.scene, "size": [854, 480], "settings": "default", "seed": cell.seed,
        "iterations": 1500,
        "variant": "given masks" if cell.benchmark == "davis" else cell.variant, "cores": 2,
        **figures, "baselines": dict.fromkeys(("flow_interpolation", "static", "warp_by_depth"), whole), "seconds": seconds,
        "psnr": 33.333, "ssim": 0.9555, "lpips": 0.0999, "covisible": 33.333, "flow": whole, "tracks": whole,
        "moving": 31.111, "gaps": dict.fromkeys(("1", "3", "5", "end"), whole), "parameters": {"bytes": 2.3e7},
        "figures": dict.fromkeys((*keys, *more), 99.999), "own": {"objects": [one] * 4}, "true": {"objects": [one] * 4},
        "gaussians": {"total": 212257, "active_mean": 89820}, "page_bytes": 1.01e7, "peak_memory_gib": 3.55, "peak": 1.8,
        "default": {"psnr": 39.58, "moving": 35.77, "ssim": 0.989, "iterations": 1600, "seconds": seconds, "image_seconds": 0.012},
    }  # fmt: skip
    return Record(
        cell.benchmark,
        cell.scene,
        cell.variant,
        cell.seed,
        "abcdef0",
        "2 cores of AMD EPYC with AVX2, 24 GiB",
        2,
        9.0,
        None,
        result,
    )


def test_the_pages_of_a_whole_night_are_short():
    pages = format_pages(Records([complete(cell) for cell in list_cells()]))
    for name, page in pages.items():
        assert len(page.encode()) < 8192, name
        assert "abcdef0" in page, name
        assert "seed" not in page or "failed" not in page, name
    left = {name: page.lower().count("not measured") for name, page in pages.items()}
    assert left.pop("index") == 2, "data that are not at hand, and the demo with compiling, which no cell is"
    assert left.pop("speed") == 1, "the same demo"
    assert left.pop("ablations") == 1, "train, of which there are earlier records alone"
    assert left == dict.fromkeys(left, 0)


def test_stages_are_summed_only_where_none_is_missing():
    """A run that was continued does not know what its first stages took."""
    seconds = dict.fromkeys(STAGES, 10.0)

    def told(kept: dict[str, float]) -> str | None:
        return tell_whole_run(Records([record(30.0, seconds=kept)]).row("davis", "bear", "given"))

    assert told(seconds) == f"{10 * len(STAGES)} (stages)"
    assert told({stage: value for stage, value in seconds.items() if stage != "masks"}) == f"{10 * (len(STAGES) - 1)} (stages)"
    assert told({stage: value for stage, value in seconds.items() if stage != "cameras"}) is None
