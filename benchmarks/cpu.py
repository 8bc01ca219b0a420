"""How fast the CPU backend is on this machine: projecting and blending forward and backward, and the fused operations.

    python benchmarks/cpu.py [--count 100000] [--repeat 15] [-o benchmarks/results/cpu-<name>.json]

The work load: Gaussians on a bumpy ground with round objects, 85 % of them about 1.35 pixels and 15 % about 4 pixels large,
seen at 854 x 480. Every figure is the minimum and the median of many in one process; compare ratios, not machines.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import torch

from flowsplat.splatting import blend, project
from flowsplat.training.adam import RowAdam
from flowsplat.training.ssim import colour_loss

WIDTH, HEIGHT = 854, 480


def work_load(count: int) -> dict[str, torch.Tensor]:
    """Gaussians in front of a camera at the origin."""
    rng = np.random.default_rng(0)
    focal = 0.85 * WIDTH
    u, v = rng.uniform(0, WIDTH, count), rng.uniform(0, HEIGHT, count)
    x, y = (u - WIDTH / 2) / WIDTH, (v - HEIGHT / 2) / WIDTH
    depth = 6 - 4 * y + 0.6 * np.sin(9 * x) * np.cos(7 * y)
    for cx, cy, radius, near in ((-0.2, 0.05, 0.12, 3.0), (0.15, -0.05, 0.17, 3.8), (0.3, 0.12, 0.08, 2.5), (0, 0.15, 0.1, 2.8)):
        squared = (x - cx) ** 2 + (y - cy) ** 2
        depth = np.where(squared < radius**2, near - 3 * np.sqrt(np.maximum(radius**2 - squared, 0)), depth)
    depth *= 1 + 0.02 * rng.standard_normal(count)
    pixels = np.where(rng.random(count) < 0.15, 4.0, 1.35) * np.exp(0.3 * rng.standard_normal(count))
    scales = (pixels * depth / focal)[:, None] * np.exp(0.35 * rng.standard_normal((count, 3)))
    means = np.stack([(u - WIDTH / 2) / focal * depth, (v - HEIGHT / 2) / focal * depth, depth], 1)
    values = {
        "means": means, "quats": rng.standard_normal((count, 4)), "scales": scales, "opacities": rng.uniform(0.1, 0.99, count),
    }  # fmt: skip
    return {name: torch.from_numpy(value.astype(np.float32)).requires_grad_() for name, value in values.items()}


def measure(parts: Callable[[], list[float]], repeat: int) -> list[dict[str, float]]:
    """Minimum and median in ms of every part, after two rounds of warming up."""
    times = np.array([parts() for _ in range(repeat + 2)][2:]) * 1e3
    both = zip(times.min(0), np.median(times, 0), strict=True)
    return [{"min_ms": round(float(a), 2), "median_ms": round(float(b), 2)} for a, b in both]


def rasterizer(count: int, channels: int, repeat: int) -> dict[str, dict[str, float]]:
    """Projection, blending and the gradient of both."""
    g = work_load(count)
    features = torch.randn(count, channels, requires_grad=True)
    viewmat, focal = torch.eye(4), 0.85 * WIDTH
    K = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    gradient = torch.randn(HEIGHT, WIDTH, channels)

    def parts() -> list[float]:
        start = time.perf_counter()
        projected = project(g["means"], g["quats"], g["scales"], g["opacities"], viewmat, K, WIDTH, HEIGHT)
        projected_at = time.perf_counter()
        image, _ = blend(projected, g["opacities"], features, WIDTH, HEIGHT)
        blended_at = time.perf_counter()
        image.backward(gradient)
        return [projected_at - start, blended_at - projected_at, time.perf_counter() - blended_at]

    return dict(zip(("project", "blend", "backward"), measure(parts, repeat), strict=True))


def operations(repeat: int) -> dict[str, dict[str, float]]:
    """The fused colour loss with its gradient, and one Adam step of 200,000 rows of 48 numbers."""
    image, target = torch.rand(HEIGHT, WIDTH, 3, requires_grad=True), torch.rand(HEIGHT, WIDTH, 3)
    value, gradient = torch.randn(200_000, 48), torch.randn(200_000, 48)
    adam, rows, rates = RowAdam({"p": value}), torch.arange(200_000), torch.full((48,), 1e-3)

    def parts() -> list[float]:
        start = time.perf_counter()
        colour_loss(image, target, 0.2).backward()
        lost_at = time.perf_counter()
        adam.begin_step(rows)
        adam.step("p", value, rows, gradient, rates)
        return [lost_at - start, time.perf_counter() - lost_at]

    return dict(zip(("colour loss", "adam"), measure(parts, repeat), strict=True))


def processor() -> str:
    """Its name, where the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    name = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())
    flags = next((line for line in lines if line.startswith("flags")), "")
    return f"{name}, {'AVX-512' if 'avx512f' in flags else 'AVX2' if 'avx2' in flags else 'other'}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--repeat", type=int, default=15)
    parser.add_argument("-o", "--out", type=Path)
    options = parser.parse_args()
    threads = numba.get_num_threads()
    torch.set_num_threads(threads)
    result = {
        "machine": processor(), "cores": os.cpu_count(), "threads": threads, "count": options.count,
        "size": [WIDTH, HEIGHT], "rasterizer": {f"C={c}": rasterizer(options.count, c, options.repeat) for c in (3, 6, 10)},
        "operations": operations(options.repeat),
    }  # fmt: skip
    text = json.dumps(result, indent=1)
    print(text)
    if options.out:
        options.out.write_text(text + "\n")
