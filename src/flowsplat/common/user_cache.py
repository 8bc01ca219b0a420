"""The folder in which this user's programs keep what they can make anew."""

from __future__ import annotations

import contextlib
import os
import stat
import sys
import tempfile
from functools import cache
from pathlib import Path


def cache_folder() -> Path:
    """flowsplat's own in the folder for caches that the system has; what ``FLOWSPLAT_CACHE`` names where that is set.

    Where there is no home folder, or it cannot be written, it is a folder of this user alone among the temporary files: kernels
    that are compiled by one process and not found by the next would be compiled each time.
    """
    if own := os.environ.get("FLOWSPLAT_CACHE"):
        return Path(own)
    try:
        folder = _system_folder() / "flowsplat"
    except RuntimeError:  # there is no home
        return _private_folder(tempfile.gettempdir())
    return folder if _can_be_written(folder) else _private_folder(tempfile.gettempdir())


def _system_folder() -> Path:
    """Where the system has what can be made anew.

    Raises:
        RuntimeError: the user has no home folder.
    """
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


@cache
def _can_be_written(folder: Path) -> bool:
    """Return whether it is there or can be made, and may be written."""
    for path in (folder, *folder.parents):
        if os.path.lexists(path):
            return path.is_dir() and os.access(path, os.W_OK | os.X_OK)
    return False


@cache
def _private_folder(temporary: str) -> Path:
    """Return a folder that nobody else may write into: what is loaded from it is run. The same one for every process of the user;
    where somebody else has that name, one for this process and those that it starts.

    Where nothing can be written at all nothing is kept, and nothing fails.
    """
    user = os.getuid() if hasattr(os, "getuid") else None
    folder = Path(temporary) / ("flowsplat" if user is None else f"flowsplat-{user}")
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if user is None or (stat.S_ISDIR(found.st_mode) and found.st_uid == user and not stat.S_IMODE(found.st_mode) & 0o022):
            return folder
    own = Path(os.devnull) / "flowsplat"
    with contextlib.suppress(OSError):
        own = Path(tempfile.mkdtemp(prefix="flowsplat-", dir=temporary))
    os.environ["FLOWSPLAT_CACHE"] = str(own)
    return own
