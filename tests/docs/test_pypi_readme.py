"""The README for PyPI."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

TOP = Path(__file__).parent.parent.parent


def test_every_link_becomes_absolute():
    specification = importlib.util.spec_from_file_location("pypi_readme", TOP / "docs" / "tools" / "pypi_readme.py")
    tool = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(tool)
    before = (TOP / "README.md").read_text(encoding="utf-8")
    text = tool.with_absolute_links(before, "https://example.org/blob/", "https://example.org/raw")
    links = re.findall(r"(!?)\[[^\]]*\]\(([^)]+)\)", text)
    assert len(links) == len(re.findall(r"\]\(", before)) > 8
    for mark, target in links:
        assert target.startswith(("https://", "#"))
        if mark:
            assert target.startswith("https://example.org/raw/docs/images/")
            assert (TOP / target.removeprefix("https://example.org/raw/")).exists()
    kept = "[a](https://elsewhere.org/x) [b](#here)"
    assert tool.with_absolute_links(kept, "p", "q") == kept
