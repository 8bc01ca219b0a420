"""Puts the sheet on filming, which the studio shows, into its page while the site is built, so that there is one of it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

PAGE, MARK = "filming.md", "<!-- the sheet -->"
SHEET = Path(__file__).parents[2] / "src/flowsplat/studio/assets/filming.html"


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by MkDocs for every page."""
    return markdown.replace(MARK, sheet()) if page.file.src_uri == PAGE else markdown


def sheet() -> str:
    """What stands in the sheet, with its style, as HTML that may stand in Markdown: without empty lines and its title."""
    text = SHEET.read_text(encoding="utf-8")
    style, body = re.findall(r"<style>(.*?)</style>.*<main>(.*)</main>", text, re.S)[0]
    # The site has its own colors for the page, and its own headings.
    own = "\n".join(line for line in style.splitlines() if not line.startswith(("* {", "body {", "h1 {", "@media print")))
    body = re.sub(r"<h1>.*?</h1>\n", "", body)
    return f"<style>\n{own.strip()}\n</style>\n<div>\n{body.strip()}\n</div>"
