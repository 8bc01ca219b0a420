"""Measure how the cost grows with the number of Gaussians, of pixels and of channels, one of them at a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from flowsplat_benchmarks.scripts.cpu_parts.machine import Limits
from flowsplat_benchmarks.scripts.cpu_parts.rasterizer import RenderCase
from flowsplat_benchmarks.scripts.cpu_parts.timing import Job, interleave
from flowsplat_benchmarks.scripts.cpu_parts.work_load import COUNT, WorkLoad, work_load

SIZES = {
    "240p": (427, 240), "360p": (640, 360), "480p": (854, 480), "720p": (1280, 720), "1080p": (1920, 1080), "4K": (3840, 2160),
}  # fmt: skip


def measure(
    limits: Limits, counts: Sequence[int], sizes: Sequence[str], channels: Sequence[int], threads: int, repeat: int
) -> dict[str, Any]:
    """Return three families; whatever does not grow is 100,000 Gaussians, 854 x 480, C = 3.

    ``gaussians``: the same surface cut into more and smaller ones. ``pixels``: the same scene in a larger image.
    """
    width, height = SIZES["480p"]
    loads: dict[str, dict[str, tuple[WorkLoad, int]]] = {
        "gaussians": {f"{n:,}": (work_load(n, width, height, (COUNT / n) ** 0.5), 3) for n in counts},
        "pixels": {name: (work_load(COUNT, *SIZES[name], SIZES[name][0] / width), 3) for name in sizes},
        "channels": {f"C = {c}": (work_load(COUNT, width, height), c) for c in channels},
    }
    result: dict[str, Any] = {}
    for family, members in loads.items():
        images = {name: RenderCase(load, c, threads) for name, (load, c) in members.items()}
        jobs: dict[str, Job] = {name: image.job for name, image in images.items()}
        parts = interleave({**limits.jobs([threads]), **jobs}, repeat)
        result[family] = {name: image.result(parts[name], limits) | image.counts.to_json() for name, image in images.items()}
    return result
