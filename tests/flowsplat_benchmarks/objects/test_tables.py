from __future__ import annotations

import numpy as np

from flowsplat_benchmarks.objects.tables import HEADER, is_anchored, summary, tables


def obj(kind: str = "walker", error: float | None = 0.1, **more) -> dict:
    found = error is not None
    facts = {"kind": kind, "contact": [0.1], "swings": False, "rolls": False, "rests": False, "touches": None, "found": found}
    spread = {"depth_trajectory": 0.02 if found else None, "shape_offset": 0.01 if found else None}
    return {**facts, **spread, "ln_distance": error, "idf1": 0.5, "iou": 0.6, **more}


def result(*objects: dict) -> dict:
    part = {"objects": list(objects), "idf1": 0.7, "parallax": True, "static": {"median": 0.01, "p90": 0.05}, "feet": None}
    return {"camera": "arc", "ground": "flat", "own": part, "true": part}


def test_what_was_never_found_is_infinitely_wrong():
    errors = [0.01, -0.02, 0.03, -0.04, 0.5, None, None, None, None, None]
    row = summary([obj(error=error) for error in errors])
    assert row["lost"] == 5
    assert row["median"] == 0.5
    assert row["high"] == np.inf
    assert row["within"] == 0.4
    assert row["signed"] == 0.01
    few = summary([obj(error=0.1 * n) for n in range(1, 11)])
    assert (round(few["median"], 6), round(few["high"], 6)) == (0.5, 0.9)
    assert summary([obj(error=None)])["signed"] is None


def test_rows_by_kind_and_camera():
    bird = obj("flier", None, contact=[])
    own, true, static = tables([result(obj(), obj("door", -0.3, contact=[], swings=True), bird)])
    assert own.rows == true.rows
    rows = {row[0]: row[1:] for row in own.rows}
    assert rows["all"][:4] == ("3", "1", "0.300", "not found")
    assert rows["touch, swing, roll or rest at any time"][0] == "2"
    assert rows["nothing ties them"][:3] == ("1", "1", "not found")
    assert rows["kind: walker"][2] == "0.100"
    assert rows["camera: arc"][0] == rows["ground: flat"][0] == "3"
    assert "camera: still" not in rows
    assert "0.70" in own.note
    assert own.header == HEADER
    assert [row[1:] for row in static.rows] == [("1", "0.010", "0.050", "–", "–")] * 2
    assert is_anchored(obj())
    assert not is_anchored(bird)


def test_coverage_is_told_where_errors_are_believed():
    own, _, _ = tables([result(obj(error=0.1, sigma=0.2), obj(error=-0.1, sigma=0.07), obj(error=0.5, sigma=0.1), obj())])
    assert own.header[-2:] == ("within 1 sigma", "within 2 sigma")
    assert own.rows[0][-2:] == ("33 %", "67 %")
