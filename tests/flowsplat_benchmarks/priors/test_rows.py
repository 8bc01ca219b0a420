from __future__ import annotations

import pytest

from flowsplat_benchmarks.priors.rows import FIGURES, table_rows


def result(scene: str, kind: str, tuned: bool = False, **figures: float) -> dict:
    return {"scene": scene, "kind": kind, "tuned": tuned, "figures": {k.replace("_", ".", 1): v for k, v in figures.items()}}


def test_targets_stand_beside_figures():
    rows = list(table_rows([
        result("a", "rig", True, flow_epe=0.35, flow_kept=84.9, flow_epe_matched=0.2), result("bear", "davis", time_total=151.0),
        result("b", "davis", time_total=151.0),
    ]))  # fmt: skip
    cells = {(row.figure, row.scene): row.cells[3:] for row in rows}
    assert cells["end-point error, mean over all pixels with true flow", "a, *tuned*"] == ("0.35 px", "≤ 0.35 px", "met")
    assert cells["pixels with a true match that the confidence keeps", "a, *tuned*"] == ("84.9 %", "≥ 85 %", "not met")
    assert cells["end-point error, mean over pixels visible in both images", "a, *tuned*"] == ("0.20 px", "", "")
    assert cells["time of all stages", "bear"] == ("151 s", "≤ 150 s", "not met")
    assert cells["time of all stages", "b"] == ("151 s", "", "")


@pytest.mark.parametrize(("values", "met"), [((0.9, 0.7, 0.5, 0.7), True), ((0.9, 0.6, 0.6, 0.6), False), ((0.9, 0.9, 0.9), None)])
def test_the_mean_of_the_clips_needs_all_of_them(values, met):
    rows = [row for row in table_rows([result(str(k), "davis", masks_iou=v) for k, v in enumerate(values)]) if "mean" in row.scene]
    assert [row.met for row in rows] == ([] if met is None else [met])


def test_every_figure_has_its_own_key():
    assert len({figure.key for figure in FIGURES}) == len(FIGURES)
