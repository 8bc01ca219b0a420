"""The command on one small world: it prepares, measures, continues, and measures again what was placed anew."""

from __future__ import annotations

import json
import os

import pytest

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.scenes import Scene
from flowsplat_benchmarks.objects import benchmark, run_objects_benchmark
from flowsplat_benchmarks.objects.benchmark import FIGURES, measure_world
from flowsplat_benchmarks.objects.preparation import prepare_world

SEED, SIZE, FRAMES = 1, (96, 54), 12
PART = {"objects": [], "idf1": 0.5}


@pytest.mark.slow
def test_a_world_is_prepared_once_and_placed_again(tmp_path):
    page = run_objects_benchmark(tmp_path, 1, SEED, size=SIZE, frames=FRAMES)
    folder = tmp_path / str(SEED)
    figures = json.loads((folder / FIGURES).read_text())
    assert [obj["kind"] for obj in figures["true"]["objects"]] == ["bouncing", "pendulum"]
    assert figures["true"]["idf1"] == 1
    assert all(obj["iou"] == 1 for obj in figures["true"]["objects"])
    assert figures["true"]["objects"][0]["ln_distance"] != 0
    assert json.loads((tmp_path / "results.json").read_text()) == [figures]
    assert "| kind: pendulum | 1 |" in (tmp_path / "objects.md").read_text()
    assert page == tmp_path / "objects.html"
    assert "True cameras, flow and masks" in page.read_text()
    own, true = Scene(folder / "own"), Scene(folder / "true")
    assert own.prior("masks")["method"] == "motion"
    assert true.prior("masks")["method"] == "truth"
    assert os.path.samefile(own.folder / "frames" / "00003.png", true.folder / "frames" / "00003.png")
    # Again: only the depth is made anew, from what is there.
    names = ("cameras.json", "masks_found/00003.png", "tracks.npz")
    kept = [(folder / variant / name) for variant in ("own", "true") for name in names]
    before = [path.stat().st_mtime_ns for path in kept]
    depth = folder / "true" / "depth" / "00003.npz"
    depth.write_bytes(b"damaged")
    (folder / FIGURES).write_text("{}")
    run_objects_benchmark(tmp_path, 1, SEED, again=True, size=SIZE, frames=FRAMES)
    assert json.loads((folder / FIGURES).read_text()) == figures
    assert [path.stat().st_mtime_ns for path in kept] == before
    with pytest.raises(InputError, match="holds a world of 12 frames of 96x54"):
        prepare_world(SEED, folder, 160, 90, FRAMES)


def test_a_killed_preparation_goes_on(tmp_path, monkeypatch):
    def killed(scene, *_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("flowsplat_benchmarks.objects.preparation.mask_stage", killed)
        with pytest.raises(KeyboardInterrupt):
            prepare_world(SEED, tmp_path / "1", *SIZE, FRAMES)
    cameras = (tmp_path / "1" / "own" / "cameras.json").stat().st_mtime_ns
    assert not (tmp_path / "1" / FIGURES).exists()
    assert measure_world(SEED, tmp_path / "1", SIZE, FRAMES, False)["seed"] == SEED
    assert (tmp_path / "1" / "own" / "cameras.json").stat().st_mtime_ns == cameras


def test_what_is_measured_is_not_measured_again(tmp_path, capsys):
    for seed in (3, 4):
        facts = {"seed": seed, "ground": "flat", "camera": "arc", "flowsplat": "0", "own": PART, "true": PART}
        (tmp_path / str(seed)).mkdir()
        (tmp_path / str(seed) / FIGURES).write_text(json.dumps(facts))
    main(["benchmark", "objects", "--worlds", "2", "--seed", "3", "-o", str(tmp_path)])
    assert "2 of 2 worlds were measured already" in capsys.readouterr().err
    assert "2 worlds, seeds 3 to 4" in (tmp_path / "objects.md").read_text()
    with pytest.raises(SystemExit) as end:
        main(["benchmark", "objects", "--worlds", "0", "-o", str(tmp_path)])
    assert end.value.code == 2
    assert "one world or more" in capsys.readouterr().err


def test_a_world_that_cannot_be_measured_is_told(tmp_path, monkeypatch, in_this_process):
    def measure(seed, *_):
        if seed == 1:
            raise InputError("torn 1.")
        return {"seed": 0, "ground": "flat", "camera": "arc", "flowsplat": "0", "own": PART, "true": PART}

    monkeypatch.setattr(benchmark, "measure_world", measure)
    with pytest.raises(InputError, match="1 of 2 worlds could not be run, first world-1: torn 1"):
        run_objects_benchmark(tmp_path, 2, 0)
    assert "1 worlds, seeds 0 to 1." in (tmp_path / "objects.md").read_text()
    assert "world-1 could not be measured: torn 1." in (tmp_path / "objects.md").read_text()
