"""How much memory a process needed."""

from __future__ import annotations

import re
import sys
from pathlib import Path


def peak_memory() -> float | None:
    """GiB that this process needed at most; None where the system does not tell."""
    try:
        # Of this program alone: what getrusage says includes the process that started it.
        found = re.search(r"VmHWM:\s*([0-9]+) kB", Path("/proc/self/status").read_text())
        if found:
            return round(int(found.group(1)) / 2**20, 2)
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30, 2)
