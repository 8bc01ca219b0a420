"""A whole training step (one frame rendered, differentiated and stepped) with its parts, and rendering to look at."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.render import render
from flowsplat.gaussians.slicing import slice_gaussians
from flowsplat.geometry import Similarity
from flowsplat.splatting import blend, project
from flowsplat.training.config import PRESETS
from flowsplat.training.trainer import Trainer
from flowsplat_benchmarks.scripts.cpu_parts import scene
from flowsplat_benchmarks.scripts.cpu_parts.clock import profile
from flowsplat_benchmarks.scripts.cpu_parts.timing import Job, interleave, significant, use_threads
from flowsplat_benchmarks.scripts.cpu_parts.work_load import HEIGHT, WIDTH

GAUSSIANS = 200_000
"""Of the scene whose training step is measured."""
DIRECTORS = (
    "training/trainer.py", "training/optimizer_step.py", "training/losses/photometric.py", "training/losses/rigid.py",
    "training/strategies/paper.py", "training/strategies/default.py", "gaussians/render.py",
)  # fmt: skip
"""The files that put a step together; what they call are its parts."""


class Training:
    """A trainer on the synthetic scene, past its warm-up: every frame was visited, neighbors are found, harmonics are full.

    Attributes:
        neighbors: seconds that finding them took.
    """

    def __init__(self, preset: str, count: int, width: int, height: int):
        config = PRESETS[preset]
        gaussians = scene.gaussians(config.model, count, width, height)
        self.observations = scene.observations(gaussians, width, height)
        self.config = replace(config, iterations=2 * scene.FRAMES, frames_per_iteration=1, preview_every=0)
        self.trainer = Trainer(self.observations, None, self.config, start=gaussians)
        parts = profile(self.trainer.run, DIRECTORS)
        self.neighbors = sum(seconds for part, seconds in parts.items() if part.endswith("find_neighbors"))

    def job(self) -> dict[str, float]:
        """Return seconds of a step."""

        def timed(step: Callable[[], object]) -> dict[str, float]:
            began = time.perf_counter()
            step()
            return {"step": time.perf_counter() - began}

        return self._with_all_losses(timed)

    def profile_job(self) -> dict[str, float]:
        """Return seconds of the parts of a step."""
        return self._with_all_losses(lambda step: profile(step, DIRECTORS))

    def _with_all_losses(self, measure: Callable[[Callable[[], object]], dict[str, float]]) -> dict[str, float]:
        """Measure steps until one had a flow loss (the last frame of the clip has none)."""
        while True:
            figures: dict[str, float | torch.Tensor] = {}
            seconds = measure(lambda: figures.update(self.trainer.iterate()[1]))  # noqa: B023
            if figures["flow"] > 0:
                return seconds

    def describe(self) -> dict[str, Any]:
        """Return what a step works on."""
        model, frame = self.trainer.gaussians, self.observations[0]
        active = model.active(frame.time, frame.camera)
        return {
            "gaussians": len(model), "active": len(active.rows), "active_moving": len(active.rows) - active.num_static,
            "numbers_per_gaussian": sum(value[0].numel() for value in model.params.values()), "sh_degree": model.sh_degree,
            "flow_model": self.config.flow_model, "rigid_neighbors": self.config.loss.rigid_neighbors,
            "depth_loss": self.config.loss.depth > 0, "neighbors_ms": significant(self.neighbors * 1e3),
            "neighbors_every": self.config.loss.rigid_refresh,
        }  # fmt: skip


def measure_training(threads: int, repeat: int, count: int = GAUSSIANS, width: int = WIDTH, height: int = HEIGHT) -> dict[str, Any]:
    """Return the frame-step of each preset, in turns."""
    use_threads(threads)
    trainings = {name: Training(name, count, width, height) for name in ("default", "paper")}
    jobs: dict[str, Job] = {}
    for name, training in trainings.items():
        jobs |= {name: training.job, f"parts of {name}": training.profile_job}
    measured = interleave(jobs, repeat)
    presets = {
        name: {**training.describe(), "step": measured[name]["step"], "parts": measured[f"parts of {name}"]}
        for name, training in trainings.items()
    }
    return {"size": [width, height], "threads": threads, "presets": presets}


def measure_viewing(threads: int, repeat: int, count: int = GAUSSIANS, width: int = WIDTH, height: int = HEIGHT) -> dict[str, Any]:
    """Return frames without gradients, three ways: colors alone (C = 3); ``render``, which adds depth; ``SceneModel.render``, which
    also fills holes and gives arrays."""
    use_threads(threads)
    model = scene.gaussians(PRESETS["default"].model, count, width, height)
    path = scene.cameras(scene.work_load(1, width, height))
    shown = SceneModel(model, Similarity(), 0.0, 1.0)
    frame = 0

    def colors(t: float) -> None:
        camera = path[frame]
        center = torch.as_tensor(camera.center, dtype=torch.float32)
        g = slice_gaussians(model, model.active(t, camera), center)
        projected = project(g.means, g.quats, g.scales, g.opacities, *camera.tensors(), width, height)
        blend(projected, g.opacities, g.colors, width, height)

    ways: dict[str, Callable[[float], object]] = {
        "colors": colors,
        "render": lambda t: render(model, path[frame], t),
        "SceneModel.render": lambda t: shown.render(path[frame], t),
    }

    @torch.no_grad()
    def job() -> dict[str, float]:
        nonlocal frame
        frame = (frame + 1) % scene.FRAMES
        seconds = {}
        for name, draw in ways.items():
            began = time.perf_counter()
            draw(frame / (scene.FRAMES - 1))
            seconds[name] = time.perf_counter() - began
        return seconds

    measured = interleave({"": job}, repeat)[""]
    for value in measured.values():
        value["frames_per_second"] = significant(1e3 / value["median_ms"])
    active = len(model.active(0.0, path[0]).rows)
    return {"size": [width, height], "threads": threads, "gaussians": len(model), "active": active, "ways": measured}
