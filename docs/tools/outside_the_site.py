"""Chooses between what a page says inside the built site and what it says where its source is read, as on a code host.

Some pages get their text while the site is built. Their source says where that text is, between two marks, and holds in a
comment what takes its place in the site.
"""

from __future__ import annotations

import re
from typing import Any

OUTSIDE = re.compile(r"<!-- outside the site -->.*?<!-- end -->\n*", re.S)
INSIDE = re.compile(r"<!-- in the site: (.*?) -->")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by MkDocs for every page, before the other hooks."""
    return INSIDE.sub(r"\1", OUTSIDE.sub("", markdown))
