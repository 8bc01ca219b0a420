"""Tables: our figures, the baselines and the published ones in their places."""

from __future__ import annotations

import pytest

from flowsplat.images.html import NOTHING
from flowsplat_benchmarks.datasets.tables import read_published, tables
from tests.flowsplat_benchmarks.datasets.conftest import figures, result


def rows_of(table) -> dict[str, dict[str, str]]:
    return {row[0]: dict(zip(table.header, row, strict=True)) for row in table.rows}


def test_published_figures_are_whole():
    known = read_published()
    for part in ("davis", "nvidia_twelve"):
        for method, values in known[part]["methods"].items():
            for metric, numbers in values.items():
                assert len(numbers) == len(known[part]["scenes"]), (method, metric)
    assert known["davis"]["methods"]["Flow Splatting"]["psnr"] == [31.88, 28.48, 29.27, 33.45, 29.51]
    assert all(len(values) == len(known["nvidia"]["columns"]) for values in known["nvidia"]["methods"].values())
    assert all(part["source"] for part in known.values())


def test_davis_beside_the_paper():
    results = [
        result("bear"),
        result("lucia", ours=figures(29.5)),
        result("bear", variant="own masks", ours=figures(30.0), name="bear_own-masks_default"),
    ]
    found = tables("davis", results)
    psnr = found[0]
    rows = rows_of(psnr)
    assert psnr.header[:3] == ("method", "bear, *tuned*", "breakdance-flare")
    assert psnr.header[-3:] == ("lucia", "mean of the 5 published", "mean of those run here")
    assert rows["Flow Splatting (the paper)"]["bear, *tuned*"] == "31.88"
    assert rows["Flow Splatting (the paper)"]["lucia"] == NOTHING
    assert rows["Flow Splatting (the paper)"]["mean of the 5 published"] == "30.52"
    given, own = rows["flowsplat, given masks, default"], rows["flowsplat, own masks, default"]
    assert given["bear, *tuned*"] == "31.23"
    assert given["lucia"] == "29.50"
    assert given["mean of the 5 published"] == NOTHING
    assert given["mean of those run here"] == "30.37"
    assert own["mean of those run here"] == NOTHING  # of one of two
    assert own["bear, *tuned*"] == "30.00"
    assert own["lucia"] == NOTHING
    assert rows["flow interpolation (DIS)"]["bear, *tuned*"] == "30.75"
    assert "blend of both neighbors" not in rows  # nothing was measured
    assert [psnr.rows[k][0][:9] for k in psnr.strong] == ["flowsplat"] * 2
    lpips = rows_of(found[2])
    assert lpips["flowsplat, given masks, default"]["bear, *tuned*"] == NOTHING
    assert lpips["DG Marbles"]["bear, *tuned*"] == "0.054"


def test_refined_poses_have_columns_of_their_own():
    refined = result("bear", refined=figures(33.3))
    (images,) = [table for table in tables("davis", [refined, result("lucia")]) if table.title == "All test images"]
    rows = {(row[0], row[2]): dict(zip(images.header, row, strict=True)) for row in images.rows}
    ours = rows["bear, *tuned*", "flowsplat, given masks, default"]
    assert (ours["PSNR"], ours["PSNR, poses refined"], ours["PSNR of objects, poses refined"]) == ("31.23", "33.30", "30.30")
    assert rows["bear, *tuned*", "flow interpolation (DIS)"]["PSNR, poses refined"] == NOTHING
    assert rows["lucia", "flowsplat, given masks, default"]["PSNR, poses refined"] == NOTHING
    assert "fitted to its own image" in images.note
    strict = tables("davis", [refined])[0]
    assert rows_of(strict)["flowsplat, given masks, default"]["bear, *tuned*"] == "31.23", "the headline is strict"
    assert "refined" not in str(tables("davis", [result("bear")]))


def test_a_mean_over_the_published_scenes_needs_all_of_them():
    scenes = read_published()["davis"]["scenes"]
    results = [result(scene, ours=figures(30.0 + k)) for k, scene in enumerate(scenes)]
    row = rows_of(tables("davis", results)[0])["flowsplat, given masks, default"]
    assert row["mean of the 5 published"] == "32.00"


def test_nvidia_in_its_forms():
    given = {"protocol": "nvidia", "variant": "given cameras", "test": {"kind": "views", "count": 9}}
    marbles = [
        result("Skating", form="nerfies", ours=figures(22.0), **given),
        result("Truck", form="nerfies", ours=figures(24.0), **given),
    ]
    found = tables("nvidia", [*marbles, result("jumping", form="twelve", ours=figures(25.1), **given)])
    rows = rows_of(found[0])
    ours = rows["flowsplat, given cameras, default"]
    assert (ours["PSNR"], ours["LPIPS"], ours["training, hours"]) == ("23.00", NOTHING, "1.00")
    assert (ours["Gaussians active, thousand"], ours["Gaussians, thousand"]) == ("91", "196")
    assert rows["HyperNeRF"]["training, hours"] == ">20"
    assert rows["Flow Splatting (the paper)"]["images a second"] == "330.6"
    assert "Skating, Truck" in found[0].note
    twelve = rows_of(found[1])
    assert twelve["SplineGS"]["jumping"] == "25.50"
    assert twelve["flowsplat, given cameras, default"]["jumping"] == "25.10"


def test_errors_against_the_truth():
    region = {"median": 4.2, "last": 6.5, "within_5": 61.0, "followed": 100.0, "seen": 90.0, "points": 10.0}
    depth = {"all": {"mean": 0.03}, "static": {"mean": 0.02}, "moving": {"mean": 0.1}}
    flow = {"mean": 0.4, "median": 0.2, "moving": {"mean": 1.5, "median": 1.0}}
    rig = result(
        "workshop", "rig", tuned=True, flow_epe=flow, prior_flow_epe={**flow, "mean": 0.7}, depth_abs_rel=depth,
        tracks={"all": region, "moving": region, "static": None},
    )  # fmt: skip
    found = {table.title: table for table in tables("rig", [rig, result("garden", "rig")])}
    assert list(found) == ["All test images", "Flow, depth and tracks", "Time, memory and size"]
    rows = rows_of(found["Flow, depth and tracks"])
    workshop = rows["workshop, *tuned*"]
    assert workshop["flow of objects, mean px"] == "1.500"
    assert workshop["flow of the prior, mean px"] == "0.700"
    assert workshop["depth of static, mean %"] == "2.00"
    assert workshop["tracks on objects, median %"] == "4.20"
    assert workshop["tracks on objects after 12 frames, median %"] == "6.50"
    assert "tracks on static, median %" not in workshop  # none was measured
    assert rows["garden"]["flow of objects, mean px"] == NOTHING


def test_costs():
    (cost,) = [table for table in tables("davis", [result("bear")]) if table.title.startswith("Time")]
    row = rows_of(cost)["bear, *tuned*"]
    assert row["seconds"] == "3,608"  # without the static scene
    assert row["peak memory, GiB"] == "2.50"
    assert row["Gaussians active, mean"] == "91,000"


@pytest.mark.parametrize("protocol", ["davis", "rig", "nvidia"])
def test_without_results_there_are_no_rows_of_ours(protocol):
    assert tables(protocol, []) == []
