"""The paper's tables beside ours, from results of other benchmarks."""

from __future__ import annotations

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.files import write_json
from flowsplat_benchmarks.paper import NOT_MEASURED, list_tables, write_paper
from tests.flowsplat_benchmarks.ablations.test_training_runs import call, refuse
from tests.flowsplat_benchmarks.models.test_models import result as model_result


def cells(tables, title, row):
    table = next(table for table in tables if table.title.startswith(title))
    return dict(zip(table.header, next(each for each in table.rows if each[0] == row), strict=True))


def ablation(variant, psnr, scene="bear", seed=0):
    return {**model_result(variant, psnr, scene, seed), "protocol": "ablations"}


def davis(scene, psnr):
    return {
        "protocol": "davis", "scene": scene, "size": [854, 480], "variant": "given masks", "settings": "default", "flowsplat": "0",
        "ours": {"psnr": psnr, "ssim": 0.9, "lpips": None},
    }  # fmt: skip


def test_without_results_all_of_ours_is_not_measured():
    tables = list_tables([])
    assert [table.title.split(":")[0] for table in tables] == [
        "Table 1",
        "Table 2",
        "Table 3a",
        "Table 3b",
        "Table 5",
        "Table 5",
        "Table 6",
    ]
    assert cells(tables, "Table 3b", "all of it")["PSNR, paper"] == "28.02"
    assert cells(tables, "Table 6", "8, 8; 6, 6")["Gaussians, thousand, paper"] == "353"
    assert cells(tables, "Table 1", "HyperNeRF")["what differs"] == "we do not have these scenes"
    ours = [cells(tables, "Table 3a", row[0])["PSNR, ours"] for row in tables[2].rows]
    assert ours == [NOT_MEASURED] * 4


def test_a_row_has_the_mean_over_scenes_of_the_mean_over_seeds():
    found = [ablation("no-q", 30.0), ablation("no-q", 31.0, seed=1), ablation("no-q", 20.0, "workshop"),
             ablation("full", 33.0), ablation("full", 31.0, "workshop")]  # fmt: skip
    row = cells(list_tables(found), "Table 3a", "without q(t): constant rotation")
    assert (row["PSNR, paper"], row["PSNR, ours"]) == ("27.31", "25.25")
    assert "bear at 64x48, workshop at 64x48; 1,500 steps; 2 seeds" in row["what differs"]
    orders = cells(list_tables([ablation("orders-6633", 30.0)]), "Table 6", "6, 6; 3, 3 (the paper's)")
    assert (orders["Gaussians, thousand, ours"], orders["Gaussians active, thousand, ours"]) == ("1", "0")


def test_means_of_a_table_are_over_the_same_scenes():
    found = [ablation("orders-6633", 30.0), ablation("orders-6633", 20.0, "train"), ablation("orders-8866", 19.0, "train")]
    tables = list_tables(found)
    rows = [cells(tables, "Table 6", row) for row in ("6, 6; 3, 3 (the paper's)", "8, 8; 6, 6", "3, 3; 3, 3")]
    assert [row["PSNR, ours"] for row in rows] == ["20.00", "19.00", NOT_MEASURED]
    assert "bear" not in rows[0]["what differs"]
    apart = list_tables([found[0], found[2]])
    assert cells(apart, "Table 6", "6, 6; 3, 3 (the paper's)")["PSNR, ours"] == "30.00"
    assert next(table for table in apart if table.title.startswith("Table 6")).note.endswith("no scene was measured in all rows.")


def test_clips_and_motion_models_of_others_stand_by_scene():
    found = [davis("bear", 35.0), davis("camel", 33.0), model_result("deformation", 29.0), model_result("marbles", 28.0),
             model_result("series", 32.0),
             model_result("marbles", 20.0, "workshop")]  # fmt: skip
    tables = list_tables(found)
    ours = cells(tables, "Table 2", "Flow Splatting, ours")
    assert (ours["bear"], ours["camel"], ours["train"], ours["mean"]) == ("35.00", "33.00", NOT_MEASURED, NOT_MEASURED)
    assert ours["what differs"].startswith("given masks, default; bear at 854x480")
    assert cells(tables, "Table 2", "Flow Splatting, published")["bear"] == "31.88"
    for method, value in (("Deformable 3DGS", "29.00"), ("DG Marbles", "28.00"), ("Shape of Motion", NOT_MEASURED)):
        assert cells(tables, "Table 2", f"{method}, motion alone")["bear"] == value
    assert cells(tables, "Table 2", "Flow Splatting, motion alone")["bear"] == "32.00", "our motion stands in the same test"
    differs = cells(tables, "Table 2", "DG Marbles, motion alone")["what differs"]
    assert "motion alone, in our trainer" in differs
    assert "workshop" not in differs, "it is no scene of this table"
    elsewhere = cells(tables, "Table 1", "DG Marbles")
    assert (elsewhere["PSNR, ours"], elsewhere["what differs"]) == (NOT_MEASURED, "we do not have these scenes")


def test_the_command_reads_several_folders(tmp_path, capsys):
    write_json(tmp_path / "a" / "davis_bear.json", davis("bear", 35.0))
    write_json(tmp_path / "b" / "ablations_x.json", ablation("full", 33.0))
    call("paper", tmp_path / "a", tmp_path / "b", "-o", tmp_path / "out")
    page = (tmp_path / "out" / "paper.md").read_text()
    assert "2 results;" in page
    assert "35.00" in page
    assert (tmp_path / "out" / "paper.html").exists()
    assert "is no folder" in refuse(capsys, "paper", tmp_path / "c", "-o", tmp_path / "out")
    with pytest.raises(InputError, match="is no folder"):
        write_paper([tmp_path / "c"], tmp_path / "out")
