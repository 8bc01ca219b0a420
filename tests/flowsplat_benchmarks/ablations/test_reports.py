"""The pages of the ablations, from figures as runs leave them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from flowsplat.images.html import NOTHING
from flowsplat.scenes.layers import read_image, write_image
from flowsplat.training.config import PRESETS
from flowsplat_benchmarks.ablations import caps, flow_maps, report
from flowsplat_benchmarks.ablations.claims import CLAIMS
from flowsplat_benchmarks.tables import describe_version


def result(variant: str, psnr: float, scene: str = "bear", seed: int = 0, **changes) -> dict:
    value = {
        "protocol": "ablations", "scene": scene, "size": [427, 240], "tuned": True, "variant": variant, "settings": "",
        "seed": seed, "iterations": 1500, "cap": 240_000, "flowsplat": "0", "test": {"kind": "frames", "count": 8},
        "psnr": psnr, "ssim": 0.9,
        "lpips": None, "moving": psnr - 2, "training_psnr": psnr + 2, "flow_epe": None, "flow_prior_epe": 0.2,
        "gaussians": {"total": 200_000, "active_mean": 90_000.0}, "seconds": {"train": 61.0, "train_cpu": 110.0, "evaluate": 5.0},
        "peak_memory_gib": 1.5, "page_bytes": 9_000_000, "image_seconds": 0.04,
    }  # fmt: skip
    return {**value, **changes}


def ablations() -> list[dict]:
    found = []
    for scene, offset in (("bear", 0.0), ("train", -1.0)):
        for seed in (0, 1):
            more = {"scene": scene, "seed": seed}
            found.append(result("full", 31.0 + offset + 0.1 * seed, **more))
            found.append(result("linear", 30.0 + offset, **more))
            found.append(result("no-q", 31.0 + offset + 0.1 * (1 - seed), moving=None, **more))
            found.append(result("no-mu", 31.5 + offset + 0.1 * seed, moving=28.0 + offset, **more))
    return found


def test_flow_maps_are_shown_in_the_order_of_the_paper(tmp_path):
    (tmp_path / flow_maps.FOLDER).mkdir()
    order = ["frame", "prior", *flow_maps.COMPARED_VARIANTS]
    for k, name in enumerate(order):
        if name != "linear":
            write_image(tmp_path / flow_maps.FOLDER / f"bear_{name}.png", np.full((30, 40, 3), 10 + 30 * k, np.uint8))
    page = report.write_report(tmp_path, ablations(), {}).read_text()
    assert "Flow maps (the paper&#39;s figure): bear" in page
    assert "4 of 5 rows" in page
    assert "figure): train" not in page, "a scene without maps has none"
    sheet = read_image(tmp_path / flow_maps.FOLDER / "bear.png")
    shown = [int(sheet[y, x, 0]) for y in (20, 54) for x in (20, 64, 108, 152)]
    assert shown == [10, 40, 70, 130, 160, 190, 255, 255]


def test_ablations(tmp_path):
    page = report.write_report(tmp_path, ablations(), {"ablations_x": "it is broken"})
    text = (tmp_path / "ablations.md").read_text()
    assert "3 rows: 1 confirmed, 1 contradicted, 1 not separable, 0 no difference, 0 one run." in text
    assert "ablations_x could not be run: it is broken" in text
    rows = {line.split(" | ")[0].strip("| *"): line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")}
    base = [cell.strip("*") for cell in rows["all of it"]]
    assert base[1:6] == ["31.05 (29.05)", "30.05 (28.05)", "30.55 (28.55)", NOTHING, "0.900"]
    linear = rows["neither mu(t) nor q(t): the linear 4D Gaussian"]
    assert linear[1:5] == ["-1.05 (-1.05)", "-1.05 (-1.05)", "-1.05 (-1.05)", "0.06 (0.06)"]
    assert linear[6:9] == ["-0.85", "worse", "confirmed"]
    assert linear[-3:] == ["61", "110", "200"]
    unmoved = rows["without q(t): constant rotation"]
    assert unmoved[3] == "+0.00", "objects are not measured, and zero is not negative"
    assert unmoved[8] == "not separable"
    assert rows["without mu(t): a straight line"][8] == "contradicted (confirmed)"
    assert "## Orders" not in text, "nothing of it is measured"
    assert "bear at 427x240: 8 held-out frames" in text
    assert "Made by flowsplat 0." in text
    assert "left out" not in text
    assert page.name == "ablations.html"
    html = page.read_text()
    assert html.count('class="chart"') == 1
    assert html.count('class="bar"') == 6
    svg = ElementTree.parse(tmp_path / "ablations_representation.svg").getroot()
    assert svg.tag.endswith("svg")


def test_every_row_has_its_place(tmp_path):
    names = {claim.variant.name for claim in CLAIMS} | {claim.base.name for claim in CLAIMS}
    report.write_report(tmp_path, [result(name, 30.0, seed=seed) for name in names for seed in (0, 1)], {})
    text = (tmp_path / "ablations.md").read_text()
    assert f"{len(CLAIMS)} rows" in text
    for claim in CLAIMS:
        assert f"| {claim.variant.label} |" in text


@pytest.mark.parametrize("write", [report.write_report, caps.write_report])
def test_without_results_the_page_is_empty(tmp_path, write):
    assert write(tmp_path, [], {}).exists()


def test_caps(tmp_path):
    found, free = [], PRESETS["default"].density.max_gaussians
    for scene in ("bear", "train"):
        for cap, psnr in ((free, 31.0), (50_000, 28.0), (200_000, 30.0)):
            count = min(cap, 300_009)
            more = {
                "protocol": "caps",
                "cap": cap,
                "gaussians": {"total": count - 9, "active_mean": 0.5 * count},
                "iterations": 1600,
            }
            found.append(result(f"cap{cap}-steps1600", psnr, scene, **more, page_bytes=30 * count))
        found.append(result("cap200000-steps250", 27.0, scene, protocol="caps", cap=200_000, iterations=250))
    caps.write_report(tmp_path, found, {})
    text = (tmp_path / "caps.md").read_text()
    assert "| bear, tuned | 50,000 | 28.00 | 26.00 |" in text
    assert "| bear, tuned | free | 31.00 | 29.00 |" in text
    assert text.index("| bear, tuned | 200,000 |") < text.index("| bear, tuned | free |")
    assert "| train, tuned | 250 | 27.00 |" in text
    assert text.count("| bear, tuned | 1,600 |") == 1
    assert "49,991" in text
    assert "| 1.50 | 40.0 |" in text, "megabytes of the page, and milliseconds an image"
    for name in (*caps.COSTS, "steps"):
        drawing = (tmp_path / f"caps_{name}.svg").read_text()
        assert drawing.count('<path class="line"') == 2
        assert drawing.count("<circle") == (4 if name == "steps" else 6)
        assert text.count(f"](caps_{name}.svg)") == 1
    assert "![PSNR against megabytes of the page](caps_bytes.svg)" in text


def test_what_is_left_out_is_told(tmp_path):
    for module in (report, caps):
        path = module.write_report(tmp_path, ablations(), {}, 3).with_suffix(".md")
        assert "left out here: 3." in path.read_text()


def test_one_run_tells_nothing(tmp_path):
    report.write_report(tmp_path, [result("full", 31.0), result("sh-0", 29.0)], {})
    text = (tmp_path / "ablations.md").read_text()
    (row,) = [line for line in text.splitlines() if line.startswith("| colors of degree 0")]
    assert "| one run |" in row


def test_many_scenes_are_not_all_in_the_image(tmp_path):
    found = [result("x", 30.0, scene, cap=cap, iterations=1600) for scene in "abcdefg" for cap in (50_000, 200_000)]
    caps.write_report(tmp_path, found, {})
    assert (tmp_path / "caps_gaussians.svg").read_text().count('<path class="line"') == 5
    text = (tmp_path / "caps.md").read_text()
    assert "Images show 5 of 7 scenes." in text
    assert "| g, tuned | 50,000 |" in text


def test_states_of_the_code_are_told():
    assert describe_version([{"flowsplat": "0.1.0+a"}] * 2) == "Made by flowsplat 0.1.0+a."
    assert "of unknown version (1 run)" in describe_version([{}, {"flowsplat": "0.1.0+b"}]), "figures from before it was recorded"
    assert "2 different states" in describe_version([{"flowsplat": "0.1.0+a"}, {"flowsplat": "0.1.0+b"}])
