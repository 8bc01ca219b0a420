"""Tables as Markdown."""

from __future__ import annotations

from markupsafe import Markup

from flowsplat.images.html import NOTHING
from flowsplat_benchmarks.tables import Chart, Column, Table, compute_scaled_mean, format_page, plain, text


def test_texts():
    assert text(1234.567, 1) == "1,234.6"
    assert text(0.5, 2, sign=True) == "+0.50"
    assert text(None, 2) == NOTHING
    assert compute_scaled_mean([1.0, None, 3.0], 10) == 20
    assert compute_scaled_mean([None]) is None


def test_markdown():
    chart = (Chart("first.svg", Markup("<svg></svg>")),)
    table = Table("First", "A note.", ("method", "PSNR"), [("ours", "31.2"), ("copy", "20.1")], (0,), chart)
    page = format_page("Title", ["a remark"], [table, Table("Second", "", ("x",), [])])
    assert page.startswith("# Title\n\n- a remark\n\n## First\n")
    assert "| method | PSNR |\n| --- | --- |\n| **ours** | **31.2** |\n| copy | 20.1 |\n\nA note.\n\n![First](first.svg)\n" in page
    assert page.endswith("## Second\n\n| x |\n| --- |\n\n\n")


def test_columns_are_means_of_those_that_have_it():
    column = Column("errors, %", ("depth", "mean"), 1, factor=100)
    results = [{"depth": {"mean": 0.01}}, {"depth": None}, {}, {"depth": {"mean": 0.02}}]
    assert column.cell(*results) == "1.5"
    assert column.cell(results[1]) == NOTHING
    assert column.is_in(results)
    assert not column.is_in(results[1:3])
    assert Column("", ("x",), 2, sign=True).cell({"x": 0.5}) == "+0.50"


def test_cells_without_emphasis():
    assert plain("*shape offset*: true depth") == "shape offset: true depth"
    assert plain("bear, *tuned*") == "bear, tuned"
    assert plain("3 * 4 * 5") == "3 * 4 * 5"
