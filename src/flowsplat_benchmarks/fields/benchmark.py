"""Run the fields: first ``default`` on every scene, then each field for as many seconds as that took, and for a multiple of it."""

from __future__ import annotations

import contextlib
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import torch

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json
from flowsplat.common.memory import peak_memory
from flowsplat.common.processes import usable_cores
from flowsplat.common.source import source_state
from flowsplat.evaluation.scores import Figures, pick
from flowsplat.gaussians.model import SceneModel
from flowsplat.pipeline.folder import stage_key
from flowsplat.scenes import Scene
from flowsplat.training.config import PRESETS
from flowsplat_benchmarks.ablations.scenes import AblationScene, ablation_scenes, choose_scenes
from flowsplat_benchmarks.ablations.training_runs import TrainingRun
from flowsplat_benchmarks.ablations.variants import Variant
from flowsplat_benchmarks.fields.measure import SCORES, score_field
from flowsplat_benchmarks.fields.networks import FieldConfig, FieldName
from flowsplat_benchmarks.fields.rays import load_rays
from flowsplat_benchmarks.fields.report import DEFAULT, write_report
from flowsplat_benchmarks.fields.training import Plan, train_field
from flowsplat_benchmarks.resume import BenchmarkOptions, Measurement, measure_jobs, results_in

PROTOCOL = "fields"
SCENES = ("bear", "train")
FIELDS: tuple[FieldName, ...] = get_args(FieldName)
TIMES = (1, 10)
"""Multiples of the seconds that ``default`` takes."""
SIZE = 240
"""Long side of the clips, pixels: a field asks its network more than twenty million times for an image of twice that side."""
CHECKPOINTS = "trainings"
"""In OUT, where the trainings are that are under way."""


@dataclass(frozen=True)
class FieldRun:
    """A field on a scene.

    Attributes:
        scene: prepared or to be prepared.
        field: which.
        times: how many times the seconds of ``default``, or of ``seconds``.
        seconds: by the clock; 0 = those of ``default``.
        seed: of every random choice.
        config: the architecture.
    """

    scene: AblationScene
    field: FieldName
    times: int
    seconds: float
    seed: int
    config: FieldConfig

    @property
    def key(self) -> str:
        """A short name of all its settings."""
        case = self.scene.case
        return stage_key(
            case.scene, case.config.input, case.config.priors, self.field, self.times, self.seconds, self.seed, self.config
        )

    @property
    def name(self) -> str:
        """Of its file."""
        budget = f"{self.seconds:g}s_" if self.seconds else ""
        return f"{PROTOCOL}_{self.scene.name}_{self.field}_{budget}times-{self.times}_seed{self.seed}"

    def job(self, out: Path) -> Measurement:
        """Prepare the scene in ``out`` where it is not yet, train and measure."""
        return Measurement(self.name, self.key, partial(measure, self, out.absolute()))


def run_fields(
    root: Path,
    out: Path,
    fields: Sequence[str] = (),
    scenes: Sequence[str] = SCENES,
    times: Sequence[int] = TIMES,
    seconds: float = 0.0,
    size: int = SIZE,
    seed: int = 0,
    again: bool = False,
    options: BenchmarkOptions | None = None,
    config: FieldConfig | None = None,
) -> Path:
    """Run or resume the fields: one JSON a run, ``OUT/fields.md`` and ``.html``.

    Args:
        root: the data root.
        fields: names of fields; none = all.
        scenes: names of scenes.
        times: multiples of the seconds that ``default`` takes.
        seconds: by the clock, in the place of those of ``default``, which is not trained then; 0 = those of ``default``.
        size: long side of clips of DAVIS in pixels; 0 = as they are.
        seed: of every random choice.
        again: forget the figures of these runs that are in OUT; prepared scenes stay.
        options: how many at a time, and by what.
        config: the architecture; None = the published one.

    Returns:
        path of the page, which shows all runs in OUT with these settings.

    Raises:
        InputError: a name or a number cannot be used, an input cannot be used, or the folder cannot be written.
    """
    for name in fields:
        if name not in FIELDS:
            raise InputError(f"There is no field {name!r}: choose from {', '.join(FIELDS)}.")
    if not times or any(value < 1 for value in times) or not (math.isfinite(seconds) and seconds >= 0):
        raise InputError("--times are whole numbers from 1 on, and --seconds is a number of seconds, or 0 for those of default.")
    known = ablation_scenes(root, size)
    wanted = choose_scenes(root, known, scenes)
    chosen = [name for name in FIELDS if not fields or name in fields]
    config = config or FieldConfig()
    runs = [
        FieldRun(scene, name, value, seconds, seed, config)
        for value in dict.fromkeys(sorted(times)) for scene in wanted for name in chosen
    ]  # fmt: skip

    def report(failed: Mapping[str, str]) -> Path:
        results = results_in(PROTOCOL, out)
        names = {result["scene"] for result in results}
        there = [scene for scene in known if scene.case.scene in names]
        every = {int(result["times"]) for result in results}
        keys = {FieldRun(scene, name, value, seconds, seed, config).key for scene in there for name in FIELDS for value in every}
        keys |= {default_run(scene, seed).key for scene in there}
        found = [result for result in results if result["key"] in keys]
        return write_report(out, found, failed, len(results) - len(found))

    # Runs of default come first: what they take is how long a field is trained.
    first = [] if seconds else [default_run(scene, seed).job(out) for scene in wanted]
    jobs = [run.job(out) for run in runs]
    if again:
        _forget(jobs, out)
    # Where one of them fails, the fields of other scenes are trained nevertheless; those of its own say that it is missing.
    with contextlib.suppress(InputError):
        measure_jobs(first, out, report, "runs of default", again, options)
    return measure_jobs(jobs, out, report, "runs", False, options)


def _forget(jobs: Sequence[Measurement], out: Path) -> None:
    """Remove what is measured, and its training; what is under way goes on."""
    for job in jobs:
        if job.is_measured(make_folder(out)):
            shutil.rmtree(out / CHECKPOINTS / job.name, ignore_errors=True)
            job.file(out).unlink()


def default_run(scene: AblationScene, seed: int) -> TrainingRun:
    """Return the run of preset ``default`` on a scene, with as many steps and Gaussians as that has."""
    variant = Variant(DEFAULT, "default: Flow Splatting, ours")
    config = replace(PRESETS["default"], seed=seed, preview_every=0)
    return TrainingRun(PROTOCOL, scene, variant, config, describe_default)


def describe_default(model: SceneModel, scene: Scene, metrics: Figures) -> dict[str, Any]:
    """Return what a row of the table has beside what a training run tells: ``times``, ``inside_ssim``, ``cores``, ``threads`` and
    ``parameters``."""
    tested = metrics["heldout_views" if scene.views else "heldout_frames"]
    gaussians = model.gaussians
    count = sum(value.numel() for value in (*gaussians.params.values(), *gaussians.shared.values()))
    return {"times": 1, "inside_ssim": pick(tested, "moving", "ssim"), **_machine(), "parameters": count}


def _machine() -> dict[str, int]:
    return {"cores": usable_cores(), "threads": torch.get_num_threads()}


def measure(run: FieldRun, out: Path) -> dict[str, Any]:
    """Train a field on its scene, render what is held out, and return the figures.

    Returns:
        as ``training_runs.measure``, without what a field does not have; ``iterations`` are the steps that were made, ``planned``
        those that were to fit into the seconds; ``times``, ``wanted_seconds``, ``cores``, ``threads``, ``parameters`` (how many
        numbers), ``inside_ssim``.

    Raises:
        InputError: the input cannot be used, or ``default`` was not measured.
        Stopped: one of the signals came; the same call continues.
    """
    scene = Scene(run.scene.prepare(out))
    folder = out / CHECKPOINTS / run.name
    seconds = run.times * (run.seconds or _read_seconds(run, out))
    # The seconds are no part of the key: default measured anew takes others, and what is under way keeps those it began with.
    trained = train_field(load_rays(scene), Plan(run.field, run.config, run.seed, seconds, run.key), folder)
    made = stage_key(run.key, trained.steps, trained.planned)
    scored = score_field(trained.field, scene, folder / SCORES, made)
    figures = scored["figures"]
    return {
        "protocol": PROTOCOL, "scene": run.scene.case.scene, "size": [scene.width, scene.height],
        "tuned": run.scene.case.is_tuned, "variant": run.field, "settings": "", "seed": run.seed, "iterations": trained.steps,
        "planned": trained.planned, "times": run.times, "wanted_seconds": round(seconds, 2), "flowsplat": source_state(),
        "test": {"kind": scored["kind"], "count": pick(figures, "count") or 0},
        **{name: pick(figures, name) for name in ("psnr", "ssim", "lpips")}, "moving": pick(figures, "moving", "psnr"),
        "inside_ssim": pick(figures, "moving", "ssim"), "training_loss": trained.loss, **_machine(),
        "parameters": trained.field.parameter_count, "image_seconds": scored["image_seconds"],
        "seconds": {
            "train": round(trained.seconds, 2), "train_cpu": round(trained.processor_seconds, 2),
            "evaluate": round(scored["seconds"], 2),
        },
        "peak_memory_gib": peak_memory(),
    }  # fmt: skip


def _read_seconds(run: FieldRun, out: Path) -> float:
    """Return what the training of ``default`` took on the scene of a run, in seconds by the clock."""
    job = default_run(run.scene, run.seed).job(out)
    if not job.is_measured(out):
        raise InputError(
            f"{job.name} was not measured, and it says how long a field is trained: give --seconds, or see why it failed."
        )
    return float(read_json(job.file(out))["seconds"]["train"])
