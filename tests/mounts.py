"""Commands that see other file systems than everybody else: in a mount namespace of their own, where the system allows it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

_READ_ONLY = 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" && exec "$@"'
_NO_SHARED_MEMORY = 'mount -t tmpfs -o ro none "$0" && exec "$@"'


def read_only(folder: Path | str) -> list[str]:
    """What to put before a command for which nothing under ``folder`` can be written, not even by root."""
    return ["unshare", "-rm", "sh", "-c", _READ_ONLY, str(folder)]


def without_shared_memory() -> list[str]:
    """What to put before a command for which ``/dev/shm`` is empty and cannot be written."""
    return ["unshare", "-rm", "sh", "-c", _NO_SHARED_MEMORY, "/dev/shm"]


def _may_mount() -> bool:
    if shutil.which("unshare") is None or not Path("/dev/shm").is_dir():
        return False
    tried = [subprocess.run([*before, "true"], capture_output=True) for before in (read_only("/tmp"), without_shared_memory())]
    return all(ended.returncode == 0 for ended in tried)


needs_mounts = pytest.mark.skipif(not _may_mount(), reason="this user may not mount anything, not even for itself")
