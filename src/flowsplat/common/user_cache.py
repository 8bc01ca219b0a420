"""The folder in which this user's programs keep what they can make anew."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def cache_folder() -> Path:
    """flowsplat's own in the folder for caches that the system has; what ``FLOWSPLAT_CACHE`` names where that is set."""
    if own := os.environ.get("FLOWSPLAT_CACHE"):
        return Path(own)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "flowsplat"
