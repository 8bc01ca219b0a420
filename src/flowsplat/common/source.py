"""Identify the code that runs: what figures depend on beside their settings."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

from flowsplat import __version__

PACKAGE = Path(__file__).parents[1]


@cache
def source_state() -> str:
    """Return the version and a hash of all Python files of the package, as in ``0.2.0+1f0c63a9``."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return f"{__version__}+{digest.hexdigest()[:8]}"
