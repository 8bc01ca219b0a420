"""Which card this is, and the two limits that matter: how fast it multiplies and adds, and how fast it copies memory."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import torch
import triton
import triton.language as tl
from cpu_parts.timing import significant

COPIED = 1 << 28
"""Bytes that are copied: far more than any cache holds."""
ROUNDS, PROGRAMS, BLOCK = 4096, 4096, 1024


def describe() -> dict[str, Any]:
    """The card and the versions of what computes on it."""
    properties = torch.cuda.get_device_properties(0)
    return {
        "card": properties.name, "memory_gib": round(properties.total_memory / 2**30, 1),
        "multiprocessors": properties.multi_processor_count, "torch": torch.__version__, "triton": triton.__version__,
        "cuda": torch.version.cuda, "hip": torch.version.hip,
    }  # fmt: skip


def milliseconds(job: Callable[[], object], repeat: int, warm_up: int = 3) -> dict[str, float]:
    """Minimum and median of what the card takes from the beginning to the end of a job."""
    for _ in range(warm_up):
        job()
    times = []
    for _ in range(repeat):
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        begin.record()
        job()
        end.record()
        end.synchronize()
        times.append(begin.elapsed_time(end))
    return {"min_ms": significant(min(times)), "median_ms": significant(statistics.median(times)), "repeats": repeat}


def forget_peak() -> None:
    """Begin to watch the peak of memory anew."""
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()


def peak_gib() -> float:
    """The most memory that tensors had since then."""
    return significant(torch.cuda.max_memory_allocated() / 2**30)


@triton.jit
def _chains(out, factor, summand, ROUNDS: tl.constexpr, BLOCK: tl.constexpr):
    """Eight sums of products a lane, each of which waits for itself only."""
    a = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.float32)
    b, c, d, e, f, g, h = a + 1, a + 2, a + 3, a + 4, a + 5, a + 6, a + 7
    for _ in range(ROUNDS):
        a, b, c, d = a * factor + summand, b * factor + summand, c * factor + summand, d * factor + summand
        e, f, g, h = e * factor + summand, f * factor + summand, g * factor + summand, h * factor + summand
    tl.store(out + tl.program_id(0), tl.sum(a + b + c + d + e + f + g + h, 0))


def limits(repeat: int) -> dict[str, float]:
    """Operations a second (an FMA counts two) and bytes a second (a copy counts reading and writing)."""
    source, out = torch.empty(COPIED, dtype=torch.uint8, device="cuda"), torch.empty(PROGRAMS, device="cuda")
    target = torch.empty_like(source)
    copy = milliseconds(lambda: target.copy_(source), repeat)
    fma = milliseconds(lambda: _chains[(PROGRAMS,)](out, 0.999, 0.001, ROUNDS=ROUNDS, BLOCK=BLOCK), repeat)
    return {
        "copy_bytes_per_second": 2 * COPIED / copy["min_ms"] * 1e3,
        "flops_per_second": 16 * ROUNDS * PROGRAMS * BLOCK / fma["min_ms"] * 1e3,
    }
