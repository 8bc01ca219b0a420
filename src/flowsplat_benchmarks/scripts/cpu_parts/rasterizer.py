"""The rasterizer, forward and backward, stage by stage, beside its floor and beside plain torch."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import torch

from flowsplat.splatting import blend, project
from flowsplat_benchmarks.scripts.cpu_parts import torch_tiles
from flowsplat_benchmarks.scripts.cpu_parts.clock import KernelClock
from flowsplat_benchmarks.scripts.cpu_parts.floor import Counts, backward_flops, count_pairs, floor_seconds, forward_flops
from flowsplat_benchmarks.scripts.cpu_parts.machine import Limits
from flowsplat_benchmarks.scripts.cpu_parts.timing import Job, interleave, significant, use_threads
from flowsplat_benchmarks.scripts.cpu_parts.work_load import COUNT, WorkLoad, work_load

STAGES = {
    "project_forward": "project", "sort_by_depth": "sort", "pack_and_cut": "pack and cut", "prefix_sum": "fill",
    "tile_ranges": "fill", "fill_tiles": "fill", "blend_forward": "blend", "blend_backward": "blend",
    "gather_gradients": "gather", "project_backward": "project",
}  # fmt: skip
"""Which stage a kernel belongs to. A kernel that is not here is a stage of its own name."""


class RenderCase:
    """One work load with C random feature channels, ready to be rendered and differentiated.

    Attributes:
        counts: what there is to blend.
    """

    def __init__(self, load: WorkLoad, channels: int, threads: int):
        generator = torch.Generator().manual_seed(channels)
        self.load, self.channels, self.threads = load, channels, threads
        self.width, self.height = load.camera.width, load.camera.height
        self.leaves = load.leaves()
        self.features = torch.rand(len(load.means), channels, generator=generator, requires_grad=True)
        self.grad_image = torch.randn(self.height, self.width, channels, generator=generator)
        self.grad_alphas = torch.randn(self.height, self.width, generator=generator)
        self.view = load.camera.tensors()
        use_threads(threads)
        self.counts = count_pairs(self._project(), load.opacities, self.width, self.height)
        self.image = self.time()[0]
        self._clock = KernelClock("flowsplat.splatting.cpu", STAGES)

    def _project(self) -> Any:
        g = self.leaves
        return project(g["means"], g["quats"], g["scales"], g["opacities"], *self.view, self.width, self.height)

    def _clear(self) -> None:
        for leaf in (*self.leaves.values(), self.features):
            leaf.grad = None

    def time(self) -> tuple[torch.Tensor, dict[str, float]]:
        """The image [H, W, C], and the seconds of ``forward`` and ``backward``."""
        use_threads(self.threads)
        self._clear()
        began = time.perf_counter()
        image, alphas = blend(self._project(), self.leaves["opacities"], self.features, self.width, self.height)
        middle = time.perf_counter()
        torch.autograd.backward([image, alphas], [self.grad_image, self.grad_alphas])
        return image.detach(), {"forward": middle - began, "backward": time.perf_counter() - middle}

    def job(self) -> dict[str, float]:
        """Seconds forward and backward."""
        return self.time()[1]

    def stages_job(self) -> dict[str, float]:
        """The same, and the seconds of every stage as ``forward/<stage>`` and ``backward/<stage>``."""
        use_threads(self.threads)
        self._clear()
        with self._clock.run():
            self._clock.take()
            began = time.perf_counter()
            image, alphas = blend(self._project(), self.leaves["opacities"], self.features, self.width, self.height)
            parts = {"forward": time.perf_counter() - began, **_add_prefix("forward", self._clock.take())}
            began = time.perf_counter()
            torch.autograd.backward([image, alphas], [self.grad_image, self.grad_alphas])
            return parts | {"backward": time.perf_counter() - began, **_add_prefix("backward", self._clock.take())}

    def torch_job(self, careful: bool) -> dict[str, float]:
        """Seconds of a tile-wise torch rasterizer on the same work, which must give the same image.

        Args:
            careful: the one that was made fast, or the one that anyone would write first.

        Raises:
            RuntimeError: the images differ by more than rounding at the edges of a few supports explains.
        """
        use_threads(self.threads)
        self._clear()
        differentiate = torch_tiles.differentiate_by_rows if careful else torch_tiles.differentiate_simply
        image, _, seconds = differentiate(
            self.leaves, self.features, *self.view, self.width, self.height, self.grad_image, self.grad_alphas
        )
        difference = float((image - self.image).abs().mean())
        if not difference < 1e-5:
            raise RuntimeError(f"the torch rasterizer's image differs by {difference:.1e} on average")
        return seconds

    def result(self, parts: dict[str, dict[str, float]], limits: Limits) -> dict[str, Any]:
        """What was measured, the floor, and the ratio to it."""
        row: dict[str, Any] = {"size": [self.width, self.height], "gaussians": len(self.load.means), "channels": self.channels}
        row |= {"threads": self.threads, "forward": parts["forward"], "backward": parts["backward"]}
        for way, flops in (("forward", forward_flops), ("backward", backward_flops)):
            lowest = floor_seconds(self.counts.pairs, flops(self.channels), limits.peak(self.threads)) * 1e3
            row[f"{way}_floor_ms"] = significant(lowest)
            row[f"{way}_ratio"] = significant(parts[way]["min_ms"] / lowest)
            stages = {name.split("/")[1]: value for name, value in parts.items() if name.startswith(way + "/")}
            if stages:
                row[f"{way}_stages"] = stages
        return row


def _add_prefix(way: str, seconds: dict[str, float]) -> dict[str, float]:
    return {f"{way}/{name}": value for name, value in seconds.items()}


def label(row: RenderCase) -> str:
    """How an image is called in the result."""
    return f"{row.width}x{row.height}, C = {row.channels}, {row.threads} thread{'s' if row.threads > 1 else ''}"


def measure(
    limits: Limits,
    sizes: Sequence[tuple[int, int]],
    channels: Sequence[int],
    threads: Sequence[int],
    repeat: int,
    count: int = COUNT,
) -> dict[str, Any]:
    """All combinations of sizes, channels and threads, stage by stage. The footprints are the same in pixels at every size."""
    loads = {size: work_load(count, *size) for size in sizes}
    images = [RenderCase(loads[size], c, n) for n in threads for size in sizes for c in channels]
    jobs: dict[str, Job] = {label(image): image.stages_job for image in images}
    parts = interleave({**limits.jobs(threads, bandwidth=True), **jobs}, repeat)
    counts: dict[tuple[int, int], Counts] = {(image.width, image.height): image.counts for image in images}
    return {
        "work_load": {f"{width}x{height}": value.to_json() for (width, height), value in counts.items()},
        "rows": {label(image): image.result(parts[label(image)], limits) for image in images},
    }


def compare_with_torch(
    size: tuple[int, int], channels: int, threads: Sequence[int], repeat: int, count: int = COUNT
) -> dict[str, Any]:
    """Ours and two tile-wise torch rasterizers in turns, with each number of threads (torch is often faster with one)."""
    load = work_load(count, *size)
    images = {label(image): image for image in (RenderCase(load, channels, n) for n in threads)}
    jobs: dict[str, Job] = {}
    for name, image in images.items():
        # Ours runs several times beside each of the slow ones, so that both had the chance of a quiet moment.
        jobs |= {
            f"simple {name}": lambda image=image: image.torch_job(careful=False),  # type: ignore[misc]
            f"careful {name}": lambda image=image: image.torch_job(careful=True),  # type: ignore[misc]
            name: lambda image=image: _fastest(image, 5),  # type: ignore[misc]
        }
    parts = interleave(jobs, repeat, warm_up=0)
    result: dict[str, Any] = {}
    for name in images:
        ours = parts[name]
        result[name] = {"flowsplat": ours}
        for kind in ("simple", "careful"):
            theirs = parts[f"{kind} {name}"]
            ratios = {f"{way}_ratio": significant(theirs[way]["min_ms"] / ours[way]["min_ms"]) for way in ours}
            result[name][kind] = {**theirs, **ratios}
    return result


def _fastest(image: RenderCase, times: int) -> dict[str, float]:
    """Each way's fastest of some runs."""
    runs = [image.job() for _ in range(times)]
    return {way: min(run[way] for run in runs) for way in runs[0]}
