"""Run one training of an ablation: a variant trained on a prepared scene with one seed, to one JSON."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flowsplat.common.devices import pick_device
from flowsplat.common.memory import peak_memory
from flowsplat.common.source import source_state
from flowsplat.common.spread import spread
from flowsplat.evaluation.evaluate import evaluate
from flowsplat.evaluation.scores import Figures, pick
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.observations import load_observations
from flowsplat.output.export import export_scene
from flowsplat.output.export.options import ExportOptions
from flowsplat.pipeline.folder import stage_key
from flowsplat.scenes import Scene
from flowsplat.training.config import TrainConfig
from flowsplat.training.per_frame import PerFrameModel, train_per_frame
from flowsplat.training.scene_model import scene_model
from flowsplat.training.static import static_config, static_start
from flowsplat.training.trainer import Trainer
from flowsplat_benchmarks.ablations.flow_maps import COMPARED_VARIANTS, write_flow_map
from flowsplat_benchmarks.ablations.scenes import AblationScene
from flowsplat_benchmarks.ablations.variants import Variant
from flowsplat_benchmarks.ablations.verdicts import Run
from flowsplat_benchmarks.resume import Measurement
from flowsplat_benchmarks.tables import Result

TIMED_IMAGES = 24
"""Views of the clip, evenly over it, whose images are timed; fewer would let one that waited for the processor count."""


@dataclass(frozen=True)
class TrainingRun:
    """A variant on a scene with a seed.

    Attributes:
        protocol: ablations, caps, models or fields.
        scene: prepared or to be prepared.
        variant: how it is trained.
        config: all settings of the training, the seed among them.
        measure_more: gives further figures of the trained scene, from it, its scene and what ``evaluate`` found; a function of a
            module, as it is sent to another process.
    """

    protocol: str
    scene: AblationScene
    variant: Variant
    config: TrainConfig
    measure_more: Callable[[SceneModel, Scene, Figures], dict[str, Any]] | None = None

    def job(self, out: Path) -> Measurement:
        """Prepare the scene in ``out`` where it is not yet, train and measure."""
        name = f"{self.scene.name}_{self.variant.name}_{self.config.iterations}-steps_seed{self.config.seed}"
        return Measurement(f"{self.protocol}_{name}", self.key, partial(self._measure, out))

    @property
    def tells_costs(self) -> bool:
        """Whether it also measures the page and the time of an image, which no table of ablations shows."""
        return self.protocol in ("caps", "models", "fields")

    @property
    def key(self) -> str:
        """A short name of all its settings."""
        case = self.scene.case
        return stage_key(case.scene, case.config.input, case.config.priors, self.variant.kind, self.config)

    def _measure(self, out: Path) -> dict[str, Any]:
        return measure(self, self.scene.prepare(out), out)


def list_training_runs(
    protocol: str, scenes: Sequence[AblationScene], variants: Sequence[Variant], seeds: Sequence[int], iterations: int, cap: int
) -> Iterator[TrainingRun]:
    """Yield all of them, seed by seed and variant by variant, so that an early look at the results is an even one."""
    for seed in seeds:
        for variant in variants:
            for scene in scenes:
                yield TrainingRun(protocol, scene, variant, variant.config(iterations, cap, seed))


def measure(run: TrainingRun, path: Path, out: Path) -> dict[str, Any]:
    """Train and measure on the prepared scene in ``path``; what is an image goes into the folder ``out``.

    Returns:
        ``protocol``, ``scene``, ``size``, ``tuned``, ``variant``, ``settings``, ``seed``, ``iterations``, ``cap``, ``flowsplat``
        (``source_state``), ``device`` (``cpu`` or ``cuda``), ``test`` (``kind``, ``count``), ``psnr``, ``ssim``, ``lpips`` and
        ``moving`` (PSNR) of the held-out
        images with strict cameras, ``training_psnr``, ``flow_epe`` and ``flow_prior_epe`` (mean, pixels), ``gaussians``
        (``total``, ``active_mean``), ``page_bytes`` (of ``export --to html``) and ``image_seconds`` (by the clock, the median of
        the clip's own views), both not of ablations, ``seconds`` (``train`` by the clock, ``train_cpu`` of all cores,
        ``evaluate``), ``peak_memory_gib`` and what ``measure_more`` gives.
    """
    scene = Scene(path)
    started, processor = time.perf_counter(), time.process_time()
    model, total = _train(run, scene)
    trained, used = time.perf_counter(), time.process_time() - processor
    metrics = evaluate(model, scene, baselines=False)
    if (
        run.protocol == "ablations"
        and run.variant.name in COMPARED_VARIANTS
        and run.config.seed == 0
        and isinstance(model, SceneModel)
    ):
        write_flow_map(out, run.scene.case.scene, run.variant.name, model, scene)
    kind = "views" if scene.views else "frames"
    tested = metrics[f"heldout_{kind}"]
    evaluated, memory = time.perf_counter(), peak_memory()
    counts = [model.active_count(float(t)) for t in scene.timestamps]
    return {
        "protocol": run.protocol, "scene": run.scene.case.scene, "size": [scene.width, scene.height],
        "tuned": run.scene.case.is_tuned, "variant": run.variant.name, "settings": run.variant.settings, "seed": run.config.seed,
        "iterations": run.config.iterations, "cap": run.config.gaussians or run.config.density.max_gaussians,
        "flowsplat": source_state(), "device": pick_device(run.scene.case.config.device).type,
        "test": {"kind": kind, "count": pick(tested, "count") or 0},
        **{name: pick(tested, name) for name in ("psnr", "ssim", "lpips")}, "moving": pick(tested, "moving", "psnr"),
        "training_psnr": pick(metrics, "training_frames", "psnr"),
        **{name: pick(metrics, name, "mean") for name in ("flow_epe", "flow_prior_epe")},
        "gaussians": {"total": total, "active_mean": float(np.mean(counts))},
        **(_size_and_speed(model, scene) if run.tells_costs and isinstance(model, SceneModel) else {}),
        "seconds": {
            "train": round(trained - started, 2), "train_cpu": round(used, 2), "evaluate": round(evaluated - trained, 2),
        },
        "peak_memory_gib": memory,
        **(run.measure_more(model, scene, metrics) if run.measure_more and isinstance(model, SceneModel) else {}),
    }  # fmt: skip


def _size_and_speed(model: SceneModel, scene: Scene) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        page = export_scene(model.to("cpu"), scene, "html", Path(folder) / "page.html", ExportOptions())
        size = page.stat().st_size
    seconds = []
    for i in spread(scene.num_frames, TIMED_IMAGES):
        began = time.perf_counter()
        model.render(scene.cameras[i], float(scene.timestamps[i]))
        seconds.append(time.perf_counter() - began)
    return {"page_bytes": size, "image_seconds": statistics.median(seconds)}


def _train(run: TrainingRun, scene: Scene) -> tuple[SceneModel | PerFrameModel, int]:
    """Return the trained scene, and how many Gaussians it has."""
    observations, config = load_observations(scene), run.config
    device = pick_device(run.scene.case.config.device)
    tracks = scene.tracks if scene.has_tracks else None
    if run.variant.kind == "per_frame":
        sets = train_per_frame(observations, config, device)
        seconds = scene.timestamps[[frame.frame for frame in observations.frames]]
        return PerFrameModel([scene_model(scene, each, config) for each in sets], seconds), sum(len(each) for each in sets)
    start = None
    if run.variant.kind == "static":
        config = static_config(config)
        start = static_start(observations, tracks, config)
    gaussians = Trainer(observations, tracks, config, start=start, device=device).run()
    if device.type == "cuda":
        torch.cuda.synchronize()  # what is in its queue belongs to the seconds of training
    return scene_model(scene, gaussians, config), len(gaussians)


def comparable(
    results: Sequence[Result], protocol: str, scenes: Sequence[AblationScene], variants: Sequence[Variant], iterations: int,
    cap: int,
) -> tuple[list[Result], int]:  # fmt: skip
    """Return the results of these scenes and variants that were made with the settings of today, and how many others there are."""
    seeds = {result["seed"] for result in results}
    names = {result["scene"] for result in results}
    there = [scene for scene in scenes if scene.case.scene in names]
    keys = {run.key for run in list_training_runs(protocol, there, variants, sorted(seeds), iterations, cap)}
    found = [result for result in results if result["key"] in keys]
    return found, len(results) - len(found)


def by_run(results: Sequence[Result], variant: str, figure: tuple[str, ...]) -> dict[Run, float]:
    """Return a figure of all runs of a variant that have it."""
    runs = [result for result in results if result["variant"] == variant]
    found = {(result["scene"], result["seed"]): pick(result, *figure) for result in runs}
    return {run: float(value) for run, value in found.items() if value is not None}
