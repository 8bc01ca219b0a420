"""Render one very large image in a process of its own: how long it takes, and how much memory."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.memory import read_peak_kib
from flowsplat_benchmarks.scripts.cpu_parts.timing import interleave, use_threads
from flowsplat_benchmarks.scripts.cpu_parts.work_load import FIELDS, work_load

MODULE = "flowsplat_benchmarks.scripts.cpu_parts.large"
"""This one."""


def measure(threads: int, repeat: int, count: int = 1_000_000, width: int = 3840, height: int = 2160) -> dict[str, Any]:
    """Run this module as a process and return what it prints. Gaussians are as large in pixels as 43.6 pairs a pixel need."""
    footprint = (width * height / (854 * 480) / (count / 100_000)) ** 0.5
    load = work_load(count, width, height, footprint)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "load.npz"
        # Made here, so that making it does not count as memory of the rendering.
        np.savez(path, viewmat=load.camera.viewmat, K=load.camera.K, **{name: getattr(load, name) for name in (*FIELDS, "colors")})
        command = [sys.executable, "-m", MODULE, str(path), *map(str, (width, height, threads, repeat))]
        output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    result: dict[str, Any] = json.loads(output)
    return {"size": [width, height], "gaussians": count, "channels": 3, "threads": threads, **result}


def peak_mib() -> float:
    """Return the most memory that this process held so far; 0 where the system does not tell."""
    return (read_peak_kib() or 0.0) / 1024


def main(path: str, width: int, height: int, threads: int, repeat: int) -> dict[str, Any]:
    """Render and differentiate the saved work load; what ``measure`` returns."""
    import torch

    import flowsplat

    use_threads(threads)
    with np.load(path) as saved:
        arrays = {name: torch.from_numpy(saved[name]) for name in saved.files}
    view = arrays["viewmat"].float(), arrays["K"].float()
    leaves = [arrays[name] for name in (*FIELDS, "colors")]

    def drawn(given: Sequence[torch.Tensor], size: tuple[int, int]) -> torch.Tensor:
        means, quats, scales, opacities, colors = given
        return flowsplat.rasterize(means, quats, scales, opacities, colors, *view, *size)[0]

    drawn([leaf[:100] for leaf in leaves], (64, 64))  # loads the kernels
    before = peak_mib()

    def forward() -> dict[str, float]:
        with torch.no_grad():
            return _time(lambda: drawn(leaves, (width, height)))

    gradient = torch.full((height, width, 3), 1e-6)

    def both() -> dict[str, float]:
        for leaf in leaves:
            leaf.requires_grad_().grad = None
        return _time(lambda: drawn(leaves, (width, height)).backward(gradient))

    rendering = interleave({"": forward}, repeat)[""]["seconds"]
    rendered = peak_mib()
    training = interleave({"": both}, repeat)[""]["seconds"]
    return {
        "forward": rendering, "forward_and_backward": training,
        "memory_mib": {"before": round(before), "forward": round(rendered), "forward_and_backward": round(peak_mib())},
    }  # fmt: skip


def _time(action: Callable[[], object]) -> dict[str, float]:
    began = time.perf_counter()
    action()
    return {"seconds": time.perf_counter() - began}


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], *map(int, sys.argv[2:]))))
