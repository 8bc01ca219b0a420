"""Turns the formulas of the pages into MathML while the site is built: browsers draw it themselves, without script or network."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.S)
"""What the extension ``pymdownx.arithmatex`` leaves of a formula (``generic: true``)."""


BAR = "<mo>&#x0007C;</mo>"
"""A bar of an absolute value, which is no sign between two numbers: it has no room around it."""


def on_page_content(content: str, **_: Any) -> str:
    """Called by MkDocs for every page."""
    return FORMULA.sub(_to_mathml, content)


def _to_mathml(match: re.Match[str]) -> str:
    tag, latex = match.groups()
    inline = tag == "span"
    formula = convert(html.unescape(latex).strip(), display="inline" if inline else "block")
    formula = formula.replace(BAR, BAR.replace("<mo>", '<mo lspace="0" rspace="0" stretchy="false">'))
    return f'<{tag} class="formula">{formula}</{tag}>'
