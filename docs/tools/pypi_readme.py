"""The README with absolute links, as PyPI needs it, where files beside it are not there.

    python docs/tools/pypi_readme.py https://example.org/blob/v0.2.0 https://example.org/raw/v0.2.0 > out/README.md

The first address is that of pages, the second that of images.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

README = Path(__file__).parent.parent.parent / "README.md"


def with_absolute_links(text: str, pages: str, images: str) -> str:
    """The text with every link to a file of the repository made absolute; links that are absolute, and to places in it, stay."""

    def absolute(match: re.Match[str]) -> str:
        mark, words, target = match.groups()
        base = images if mark else pages
        return f"{mark}[{words}]({base.rstrip('/')}/{target})"

    return re.sub(r"(!?)\[([^\]]*)\]\((?!\w+:|#)([^)]+)\)", absolute, text)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    print(with_absolute_links(README.read_text(encoding="utf-8"), *sys.argv[1:]), end="")
