"""Quick oracles: distances come out as wrong as they are, of rendered scenes and of worlds, and the tables say so."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flowsplat.scenes import Scene
from flowsplat_benchmarks.oracles import quick
from flowsplat_benchmarks.oracles.quick import World, measure_distances, parse_worlds
from flowsplat_benchmarks.oracles.scenes import make_oracle
from tests.flowsplat_benchmarks.oracles.conftest import CONSTANT, SHAPE_OFFSET, STATIC
from tests.flowsplat_benchmarks.oracles.test_benchmark import call, refuse

DISTANCE = {"own": -0.25, "ids": 0.125, "shadow": -0.0625, "parts": 0.03125, "masks": None}


def test_errors_are_those_that_were_put_in(wrong_scene, tmp_path):
    found = measure_distances(Scene(wrong_scene), by_static_depth=False)
    first, *others = found["objects"]
    assert first["ln_distance"] == pytest.approx(CONSTANT, abs=SHAPE_OFFSET)
    assert [obj["ln_distance"] for obj in others] == pytest.approx([-0.2] * 2, abs=1e-3)
    assert found["static"] == pytest.approx(STATIC, abs=1e-3)
    by_static = measure_distances(Scene(wrong_scene), by_static_depth=True)
    assert by_static["objects"][1]["ln_distance"] == pytest.approx(-0.2 - STATIC, abs=1e-3)
    true = measure_distances(make_oracle(wrong_scene, tmp_path / "masks", "masks"), by_static_depth=False)
    assert true["idf1"] == 1 > found["idf1"]
    assert [obj["iou"] for obj in true["objects"]] == [1, 1, 1]


def test_worlds_are_told_from_scenes():
    assert parse_worlds(["street", "crowd-3", "any-12", "dancers-0", "crowd"]) == (
        [World("crowd", 3), World("any", 12), World("dancers", 0)], ["street", "crowd"],
    )  # fmt: skip


@pytest.fixture
def measured(monkeypatch, in_this_process):
    """Stands in for preparing, making and measuring."""
    done = []

    def measure(oracle, by_static_depth):
        done.append((oracle, by_static_depth))
        obj = {"frames": 12, "ln_distance": DISTANCE[oracle], "iou": 0.5}
        return {"idf1": 0.75, "static": 0.0125, "objects": [obj, {**obj, "ln_distance": 0.5}]}

    monkeypatch.setattr(quick, "prepare_scene", lambda _, folder: folder)
    monkeypatch.setattr(quick, "prepare_world", lambda *_: None)
    monkeypatch.setattr(quick, "place_objects", lambda _: None)
    monkeypatch.setattr(quick, "Scene", lambda folder: folder)
    monkeypatch.setattr(quick, "make_oracle", lambda prepared, folder, oracle, device: oracle)
    monkeypatch.setattr(quick, "measure_distances", measure)
    return done


def test_tables(runs_root, tmp_path, measured):
    call(runs_root, "-o", tmp_path, "--quick", "--scenes", "tiny", "crowd-3")
    assert measured == [(oracle, is_world) for is_world in (False, True) for oracle in DISTANCE]
    text = (tmp_path / "oracles_quick.md").read_text()
    assert "| scene | true object | frames | own | ids | shadow | parts | masks |" in text
    assert "| tiny | 1 | 12 | -0.250 | +0.125 | -0.062 | +0.031 | – |" in text
    assert "| crowd-3, *tuned* | 2 | 12 | +0.500 |" in text
    assert "| tiny | own priors as they are | 2 of 2 | 0.750 | 0.500 | 0.375 | 0.500 | 0.0125 |" in text
    assert "all true, what was not found, too; the depth is our own | 1 of 2 | 0.750 | 0.500 | 0.500 |" in text
    assert (tmp_path / "oracles_quick.html").exists()
    call(runs_root, "-o", tmp_path, "--quick", "--scenes", "tiny", "crowd-3")
    assert len(measured) == 10, "it continues"
    call(runs_root, "-o", tmp_path, "--quick", "--scenes", "crowd-3", "--oracles", "shadow", "own")
    assert measured[10:] == [("own", True), ("shadow", True)]


def test_bad_input_is_one_line(runs_root, tmp_path, capsys):
    out = tmp_path / "out"
    assert "no scene 'x': choose from tiny" in refuse(capsys, runs_root, "-o", out, "--quick", "--scenes", "x")
    assert "no oracle 'x': choose from own" in refuse(capsys, runs_root, "-o", out, "--quick", "--oracles", "x")
    assert "crowd-900 is not looked at" in refuse(capsys, runs_root, "-o", out, "--quick", "--scenes", "crowd-900")
    assert "crowd-3 has no held-out cameras" in refuse(capsys, runs_root, "-o", out, "--scenes", "crowd-3")
    assert not out.exists()


@pytest.mark.slow
def test_a_world_and_a_scene_are_measured(runs_root, tmp_path, monkeypatch, in_this_process):
    for name, value in (("WIDTH", 160), ("HEIGHT", 90), ("FRAMES", 12)):
        monkeypatch.setattr(quick, name, value)
    call(runs_root, "-o", tmp_path, "--quick", "--scenes", "tiny", "crowd-0")
    for name, objects in (("tiny", 3), ("crowd-0", 3)):
        found = json.loads((tmp_path / f"oracles-quick_{name}.json").read_text())["oracles"]
        assert list(found) == list(DISTANCE)
        assert all(len(each["objects"]) == objects for each in found.values())
        assert found["masks"]["idf1"] == 1
        assert all(np.isfinite(obj["ln_distance"]) for obj in found["masks"]["objects"])
        assert found["own"]["idf1"] <= found["ids"]["idf1"]
