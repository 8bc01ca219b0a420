"""Identify the machine, and measure the two limits that matter: how fast it multiplies and adds, and how fast it reads memory."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numba
import numpy as np
import torch
from numba import config, njit

from flowsplat.common.simd import LANES, broadcast, largest_lane, maximum
from flowsplat.common.threads import kind_of_threads, parallel_for, thread_count
from flowsplat_benchmarks.scripts.cpu_parts.timing import Job, significant, use_threads

ARITHMETIC_ROUNDS = 200_000
"""How often the chain of arithmetic is gone through."""
TRIAD_SIZE = 1 << 25
"""Floats in each of three arrays of 128 MiB: far beyond any cache."""
OPTIONS = {"error_model": "numpy", "nogil": True}
"""Not cached on disk: the cache does not notice when ``simd`` changes the width of a vector."""


def describe() -> dict[str, Any]:
    """Return the machine and the versions of what computes on it."""
    return {
        "processor": _processor(),
        "instructions": _instructions(),
        "cores": os.cpu_count(),
        "memory_gib": _memory(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
        "numba": numba.__version__,
        "llvmlite": llvmlite.__version__,
        "threading_layer": kind_of_threads(),
        "compiled_for": config.CPU_NAME or llvm.get_host_cpu_name(),
    }


def commit(folder: Path) -> dict[str, Any]:
    """Return what of the repository that ``folder`` is in was measured; nulls where there is no git."""
    try:
        run = lambda *words: subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=True).stdout  # noqa: E731
        return {
            "commit": run("rev-parse", "HEAD").strip(),
            "changed": bool(run("status", "--porcelain", ":/src/flowsplat").strip()),
        }
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "changed": None}


def load() -> list[float] | None:
    """Return how busy the machine was over the last 1, 5 and 15 minutes, in waiting threads."""
    return [round(value, 2) for value in os.getloadavg()] if hasattr(os, "getloadavg") else None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())


def _instructions() -> str:
    """Return the widest vectors that kernels are compiled for."""
    if config.CPU_NAME == "haswell":
        return "AVX2"
    features = llvm.get_host_cpu_features()
    names = (("avx512f", "AVX-512"), ("avx2", "AVX2"), ("sve", "SVE"), ("neon", "NEON"))
    return next((label for name, label in names if features.get(name)), "other")


def _memory() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (ValueError, OSError, AttributeError):
        return None


@njit(**OPTIONS)
def _six_chains(rounds, factor, summand):
    """Six sums that wait for themselves only: as many as fit into 16 registers of half a vector."""
    f, s = broadcast(factor), broadcast(summand)
    a, b, c, d, e, g = f, f + s, f - s, s, f * s, s - f
    for _ in range(rounds):
        a = a * f + s
        b = b * f + s
        c = c * f + s
        d = d * f + s
        e = e * f + s
        g = g * f + s
    return largest_lane(maximum(maximum(maximum(a, b), maximum(c, d)), maximum(e, g)))


@njit(**OPTIONS)
def _twelve_chains(rounds, factor, summand):
    """Twelve: enough to hide the latency of two units, where there are registers for them."""
    f, s = broadcast(factor), broadcast(summand)
    a, b, c, d, e, g = f, f + s, f - s, s, f * s, s - f
    h, i, j, k, l, m = a + a, b + b, c + c, d + d, e + e, g + g
    for _ in range(rounds):
        a = a * f + s
        b = b * f + s
        c = c * f + s
        d = d * f + s
        e = e * f + s
        g = g * f + s
        h = h * f + s
        i = i * f + s
        j = j * f + s
        k = k * f + s
        l = l * f + s
        m = m * f + s
    first = maximum(maximum(maximum(a, b), maximum(c, d)), maximum(e, g))
    return largest_lane(maximum(first, maximum(maximum(maximum(h, i), maximum(j, k)), maximum(l, m))))


@njit(**OPTIONS)
def _multiply_add(begin, end, rounds, twelve, factor, summand, out):
    for thread in range(begin, end):
        if twelve:
            out[thread] = _twelve_chains(rounds, factor, summand)
        else:
            out[thread] = _six_chains(rounds, factor, summand)


@njit(fastmath=True, **OPTIONS)
def _triad(begin, end, a, b, c, factor):
    for i in range(begin, end):
        a[i] = b[i] + factor * c[i]


class Limits:
    """The FMA peak and the memory bandwidth, measured again and again beside whatever is compared with them."""

    def __init__(self) -> None:
        self._peaks: dict[int, list[float]] = {}
        self._bandwidths: dict[int, list[float]] = {}
        self._arrays: list[np.ndarray] = []
        _measure_peak(thread_count(), True, 1)  # compiles
        _measure_peak(thread_count(), False, 1)

    def jobs(self, threads: Sequence[int], bandwidth: bool = False) -> dict[str, Job]:
        """Jobs for ``interleave`` that measure the peak, and the bandwidth too if asked for."""
        jobs: dict[str, Job] = {}
        for count in threads:
            jobs[f"peak {count}"] = lambda count=count: self._peak(count)  # type: ignore[misc]
            if bandwidth:
                jobs[f"bandwidth {count}"] = lambda count=count: self._bandwidth(count)  # type: ignore[misc]
        return jobs

    def peak(self, threads: int) -> float:
        """Return the highest number of floating-point operations a second that was seen."""
        return max(self._peaks[threads])

    def to_json(self) -> dict[str, Any]:
        """By number of threads, best and median: GFLOP/s, and GB/s of a + factor b -> c (three arrays, as STREAM counts)."""
        return {
            f"{threads} thread{'s' if threads > 1 else ''}": {
                "fma_gflops": _best_and_median(self._peaks[threads]),
                **({"triad_gbs": _best_and_median(self._bandwidths[threads])} if threads in self._bandwidths else {}),
            }
            for threads in sorted(self._peaks)
        }

    def _peak(self, threads: int) -> dict[str, float]:
        use_threads(threads)
        values = self._peaks.setdefault(threads, [])
        # Short tries, so that one of them finds all cores free.
        values.append(max(_measure_peak(threads, twelve, ARITHMETIC_ROUNDS) for twelve in 5 * (True, False)))
        return {}

    def _bandwidth(self, threads: int) -> dict[str, float]:
        use_threads(threads)
        if not self._arrays:
            self._arrays = [np.ones(TRIAD_SIZE, np.float32) for _ in range(3)]
            parallel_for(_triad, TRIAD_SIZE, *self._arrays, np.float32(2), pieces=1)
        start = time.perf_counter()
        parallel_for(_triad, TRIAD_SIZE, *self._arrays, np.float32(2), pieces=1)
        seconds = time.perf_counter() - start
        self._bandwidths.setdefault(threads, []).append(3 * 4 * TRIAD_SIZE / seconds)
        return {}


def _measure_peak(threads: int, twelve: bool, rounds: int) -> float:
    out = np.zeros(threads, np.float32)
    start = time.perf_counter()
    parallel_for(_multiply_add, threads, rounds, twelve, np.float32(0.999), np.float32(0.001), out)
    return threads * rounds * (12 if twelve else 6) * 2 * LANES / (time.perf_counter() - start)


def _best_and_median(values: list[float]) -> dict[str, float]:
    return {"best": significant(max(values) / 1e9), "median": significant(float(np.median(values)) / 1e9)}
