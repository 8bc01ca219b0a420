"""Measure the memory that processes need, and how much there is.

Linux says all of it (``/proc``, cgroups). macOS says the most that this process held (``getrusage``), and Windows nothing of it:
there the tables leave memory out, and batches begin as many clips as there are cores.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import re
import sys
from collections.abc import Iterator
from pathlib import Path

_before = 0.0
"""GiB: the peak up to when ``begin_peak`` was last called."""


def peak_memory() -> float | None:
    """Return GiB that this process needed at most; None where the system does not tell."""
    recent = get_recent_peak()
    return None if recent is None else max(recent, _before)


def begin_peak() -> None:
    """Count ``get_recent_peak`` anew from here on, where the system can (Linux: https://docs.kernel.org/filesystems/proc.html)."""
    global _before
    _before = peak_memory() or _before
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def get_recent_peak() -> float | None:
    """Return GiB that this process needed at most since ``begin_peak``, or since it began; None where the system does not tell."""
    peak = read_peak_kib()
    return None if peak is None else round(peak / 2**20, 2)


def read_peak_kib() -> float | None:
    """Return KiB that this process held at most since ``begin_peak``, or since it began; None where the system does not tell."""
    with contextlib.suppress(OSError):
        # Of this program alone: what getrusage says includes the process that started it.
        found = re.search(r"VmHWM:\s*([0-9]+) kB", Path("/proc/self/status").read_text())
        if found:
            return float(found.group(1))
    try:
        import resource
    except ImportError:  # Windows
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform == "darwin" else 1)


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_MMAP_MAX = -1, -3, -4
"""Numbers of glibc: https://man7.org/linux/man-pages/man3/mallopt.3.html."""


@contextlib.contextmanager
def keep_freed_memory() -> Iterator[None]:
    """Inside, the C library keeps what is freed for what is allocated next, whatever its size; after it, the system has it back.

    A step of training frees arrays of some hundred megabytes and allocates them again. Large ones would be given back each time,
    and their pages be zeroed anew one by one, which was 7 % of the steps at 854x480. Where there is no glibc this does nothing.
    """
    try:
        library = ctypes.CDLL(None)
        choose = library.mallopt
    except (AttributeError, OSError, TypeError):
        yield
        return
    choose(_M_MMAP_MAX, 0)
    choose(_M_TRIM_THRESHOLD, 2**31 - 1)
    try:
        yield
    finally:
        # What glibc itself would have come to by now.
        choose(_M_MMAP_MAX, 65536)
        choose(_M_MMAP_THRESHOLD, 32 << 20)
        choose(_M_TRIM_THRESHOLD, 64 << 20)
        give_back_memory()


_keeps_imported = False


def keep_imported() -> None:
    """From the end of the first stage on, ``give_back_memory`` no longer looks through what is there then: modules and their
    functions, a quarter of a million objects and a quarter of a second of the processor each time. For processes that do one thing
    and end: what of it is given up later and refers to itself is not freed."""
    global _keeps_imported
    _keeps_imported = True


def give_back_memory() -> None:
    """Give what a finished stage has freed back to the system, which the C library else keeps between what is still in use.

    Where there is no glibc only unreachable objects are freed.
    """
    global _keeps_imported
    gc.collect()
    if _keeps_imported:
        gc.freeze()
        _keeps_imported = False
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def memory_of(process: int) -> float | None:
    """Return GiB that another process holds now; None where it is dead or the system does not tell."""
    try:
        found = re.search(r"VmRSS:\s*([0-9]+) kB", Path(f"/proc/{process}/status").read_text())
    except OSError:
        return None
    return int(found.group(1)) / 2**20 if found else None


def free_memory() -> float | None:
    """Return GiB that processes may still take, here and in the container that this one is in; None where the system does not
    tell."""
    free = []
    with contextlib.suppress(OSError):
        found = re.search(r"MemAvailable:\s*([0-9]+) kB", Path("/proc/meminfo").read_text())
        if found:
            free.append(int(found.group(1)) / 2**20)
    # A container's own limit: https://docs.kernel.org/admin-guide/cgroup-v2.html and its predecessor.
    for most, used, folder in (
        ("memory.max", "memory.current", Path("/sys/fs/cgroup")),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", Path("/sys/fs/cgroup/memory")),
    ):
        with contextlib.suppress(OSError, ValueError):  # "max" is none
            limit = int((folder / most).read_text())
            cached = re.search(r"^(?:total_)?inactive_file ([0-9]+)$", (folder / "memory.stat").read_text(), re.M)
            taken = int((folder / used).read_text()) - (int(cached.group(1)) if cached else 0)
            if limit < 2**60:
                free.append(max(limit - taken, 0) / 2**30)
    return min(free, default=None)
