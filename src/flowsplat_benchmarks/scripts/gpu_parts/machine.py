"""Identify the card, and measure the two limits that matter: how fast it multiplies and adds, and how fast it copies memory."""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from typing import Any

import torch
import triton
import triton.language as tl

from flowsplat_benchmarks.scripts.cpu_parts.timing import significant

COPIED_BYTES = 1 << 28
"""Bytes that are copied: far more than any cache holds."""
ARITHMETIC_ROUNDS, PROGRAMS, BLOCK = 4096, 4096, 1024
"""How often the chain of arithmetic is gone through, the programs that do it, and the numbers of one."""


def device() -> str:
    """Return what is measured: the card, or in a rehearsal the processor."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def describe() -> dict[str, Any]:
    """Return the card and the versions of what computes on it."""
    versions = {
        "torch": torch.__version__, "triton": triton.__version__, "cuda": torch.version.cuda, "hip": torch.version.hip,
        "python": platform.python_version(), "cores": os.cpu_count(),
    }  # fmt: skip
    if not torch.cuda.is_available():
        return {"card": "none: rehearsed in Triton's interpreter", **versions}
    properties = torch.cuda.get_device_properties(0)
    return {
        "card": properties.name, "memory_gib": round(properties.total_memory / 2**30, 1),
        "multiprocessors": properties.multi_processor_count, "driver": _driver(), **versions,
    }  # fmt: skip


def _driver() -> str | None:
    """Return the driver's version, where NVIDIA's own tool says it."""
    try:
        command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
        return subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout.split()[0]
    except (OSError, subprocess.SubprocessError, IndexError):
        return None


def synchronize() -> None:
    """Wait until the card has nothing left to do."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def milliseconds(job: Callable[[], object], repeat: int, warm_up: int = 3) -> dict[str, float]:
    """Minimum and median of what the card takes from the beginning to the end of a job."""
    for _ in range(warm_up):
        job()
    times = []
    for _ in range(repeat):
        if not torch.cuda.is_available():
            began = time.perf_counter()
            job()
            times.append(1e3 * (time.perf_counter() - began))
            continue
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        begin.record()
        job()
        end.record()
        end.synchronize()
        times.append(begin.elapsed_time(end))
    return {"min_ms": significant(min(times)), "median_ms": significant(statistics.median(times)), "repeats": repeat}


def forget_peak() -> None:
    """Begin to watch the peak of memory anew."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()


def peak_gib() -> float:
    """Return the most memory that tensors had since then."""
    return significant(torch.cuda.max_memory_allocated() / 2**30) if torch.cuda.is_available() else 0.0


def profile(job: Callable[[], object], repeat: int) -> dict[str, Any]:
    """Return what the card is busy with, milliseconds a job by kernel, beside what the job takes by the clock."""
    from torch.profiler import ProfilerActivity

    activities = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * torch.cuda.is_available()
    job()
    synchronize()
    began = time.perf_counter()
    for _ in range(repeat):
        job()
    synchronize()
    wall = 1e3 * (time.perf_counter() - began) / repeat
    with torch.profiler.profile(activities=activities) as profiled:
        for _ in range(repeat):
            job()
        synchronize()
    spent: dict[str, list[float]] = {}
    for event in profiled.events() or []:
        if "CUDA" in str(event.device_type):
            spent.setdefault(event.name[:60], []).append(event.device_time / 1e3)
    rows = sorted(spent.items(), key=lambda item: -sum(item[1]))
    return {
        "wall_ms": significant(wall), "busy_ms": significant(sum(map(sum, spent.values())) / repeat),
        "launches": sum(map(len, spent.values())) // repeat,
        "kernels": {
            name: {"ms": significant(sum(values) / repeat), "launches": significant(len(values) / repeat)}
            for name, values in rows[:24]
        },
    }  # fmt: skip


@triton.jit
def _chains(out, factor, summand, ROUNDS: tl.constexpr, BLOCK: tl.constexpr):
    """Eight sums of products a lane, each of which waits for itself only."""
    a = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.float32)
    b, c, d, e, f, g, h = a + 1, a + 2, a + 3, a + 4, a + 5, a + 6, a + 7
    for _ in range(ROUNDS):
        a, b, c, d = a * factor + summand, b * factor + summand, c * factor + summand, d * factor + summand
        e, f, g, h = e * factor + summand, f * factor + summand, g * factor + summand, h * factor + summand
    tl.store(out + tl.program_id(0), tl.sum(a + b + c + d + e + f + g + h, 0))


def limits(repeat: int, small: bool = False) -> dict[str, float]:
    """Operations a second (an FMA counts two) and bytes a second (a copy counts both ways); ``small``: meaningless ones."""
    if small:
        return {"copy_bytes_per_second": 1e12, "flops_per_second": 1e13}
    source, out = torch.empty(COPIED_BYTES, dtype=torch.uint8, device="cuda"), torch.empty(PROGRAMS, device="cuda")
    target = torch.empty_like(source)
    copy = milliseconds(lambda: target.copy_(source), repeat)
    fma = milliseconds(lambda: _chains[(PROGRAMS,)](out, 0.999, 0.001, ROUNDS=ARITHMETIC_ROUNDS, BLOCK=BLOCK), repeat)
    return {
        "copy_bytes_per_second": 2 * COPIED_BYTES / copy["min_ms"] * 1e3,
        "flops_per_second": 16 * ARITHMETIC_ROUNDS * PROGRAMS * BLOCK / fma["min_ms"] * 1e3,
    }
