"""A report says the same in both of its files, and the page needs nothing that is not there."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from flowsplat_benchmarks.reports import Report, failures, scene_section
from flowsplat_benchmarks.tables import Chart, Table


def test_a_report_is_markdown_and_a_page(tmp_path):
    table = Table(
        "First",
        "A note.",
        ("scene", "PSNR"),
        [("bear, *tuned*", "31.2")],
        (0,),
        (Chart("first.svg", Markup('<svg class="chart"></svg>')),),
    )
    (tmp_path / "bear").mkdir()
    (tmp_path / "bear" / "report.html").touch()
    sections = [
        scene_section(tmp_path, "bear", "12 frames", "bear/report.html", [(np.zeros((4, 6, 3), np.uint8), "its images")]),
        scene_section(tmp_path, "lucia", "9 frames", "lucia/report.html"),
    ]
    report = Report("some", "Title", "All is well.", failures({"train": "it is <torn>"}), [table], sections)
    page = report.write(tmp_path)
    assert page == tmp_path / "some.html"
    html, text = page.read_text(), (tmp_path / "some.md").read_text()
    assert "train could not be run: it is &lt;torn&gt;" in html
    assert "- train could not be run: it is <torn>" in text
    assert "**bear, *tuned***" in text
    assert "bear, tuned" in html
    assert "*" not in html.partition("<main")[2]
    assert (html.count("All of it"), html.count("<img"), html.count("<svg")) == (1, 1, 1)
    assert "All is well." in html
    assert "All is well." not in text
    assert (tmp_path / "first.svg").exists()


def test_the_verdict_can_be_the_first_remark(tmp_path):
    Report("some", "Title", "All is well.", ["So it is."], [], verdict_is_remark=True).write(tmp_path)
    assert (tmp_path / "some.md").read_text().startswith("# Title\n\n- All is well.\n- So it is.\n")
