"""Tables as Markdown."""

from __future__ import annotations

from pathlib import Path

from flowsplat.pictures.html import NOTHING
from flowsplat_benchmarks.tables import Table, markdown, scaled_mean, text


def test_texts():
    assert text(1234.567, 1) == "1,234.6"
    assert text(0.5, 2, sign=True) == "+0.50"
    assert text(None, 2) == NOTHING
    assert scaled_mean([1.0, None, 3.0], 10) == 20
    assert scaled_mean([None]) is None


def test_markdown():
    table = Table("First", "A note.", ("method", "PSNR"), [("ours", "31.2"), ("copy", "20.1")], (0,))
    page = markdown("Title", ["a remark"], [table, Table("Second", "", ("x",), [])], {"First": Path("out/first.svg")})
    assert page.startswith("# Title\n\n- a remark\n\n## First\n")
    assert "| method | PSNR |\n| --- | --- |\n| **ours** | **31.2** |\n| copy | 20.1 |\n\nA note.\n\n![First](first.svg)\n" in page
    assert page.endswith("## Second\n\n| x |\n| --- |\n\n\n")
