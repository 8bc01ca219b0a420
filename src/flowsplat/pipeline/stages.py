"""The stages of a run. Each can be called alone; each does nothing where it is finished, and continues where it was stopped."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.devices import pick_device
from flowsplat.common.durations import get_beginning
from flowsplat.common.errors import InputError
from flowsplat.common.files import hash_files, lease, read_json, require_keys, write_json
from flowsplat.common.files.json_file import Number
from flowsplat.common.memory import get_recent_peak
from flowsplat.common.progress import spinner
from flowsplat.common.run_paths import RunPaths
from flowsplat.evaluation.evaluate import evaluate
from flowsplat.evaluation.lpips_network import open_lpips
from flowsplat.evaluation.perceptual import PerceptualMetric
from flowsplat.evaluation.poses import refine_camera
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera
from flowsplat.output.report import FlowComparison, write_report
from flowsplat.output.videos import RenderOptions, are_rendered, name_of, read_swing, render_videos
from flowsplat.pipeline.coarse import coarse_scene, is_worth_it
from flowsplat.pipeline.compiling import compile_ahead
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.fitting import (
    HISTORY,
    final_key,
    fit_heldout,
    is_trained,
    one_color_model,
    static_model,
    train,
    train_key,
    wants_final,
)
from flowsplat.pipeline.folder import MetricsFile, RunFolder, stage_key
from flowsplat.pipeline.preparing import prepare_folder
from flowsplat.pipeline.shot_list import resolve_run
from flowsplat.pipeline.speed import Speed, Watch, estimate_seconds, estimate_seconds_of_clip
from flowsplat.pipeline.summary import flow_comparisons, report_data
from flowsplat.priors.objects import load_objects
from flowsplat.priors.objects.description import object_figures
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import Clip
from flowsplat.training.checkpoint import check_scene, has_model, load_model

_MAX_HISTORY_BYTES = 64 * 2**20
"""Bytes of the history of a training, at most. A round number."""


def run(source: str | Path, out: str | Path, config: RunConfig | None = None) -> dict[str, Any]:
    """Go the whole way: a clip becomes a 4D scene, images and figures. Called again, it continues.

    Args:
        source: a video, a folder of images (or with images/ and masks/), a DAVIS root, a rig scene, an NVIDIA Dynamic Scene
            or a prepared scene.
        out: folder of the run.
        config: every setting; None = the default preset.

    Returns:
        the content of ``metrics.json``.

    Raises:
        InputError: the input, a setting or the folder cannot be used.
    """
    out = Path(out)
    begun, is_new, watch = get_beginning(), not RunPaths(out).record_path.exists(), Watch()
    with lease(out):
        device = pick_device((config or RunConfig()).device).type
        with compile_ahead(device) as ahead:

            def first(folder: RunFolder, clip: Clip) -> None:
                # Kernels that are still being compiled are waited for once, after the priors.
                if (
                    folder.config.coarse_scene
                    and not ahead.is_busy
                    and is_worth_it(sum(estimate_seconds_of_clip(clip, folder.config).values()))
                ):
                    coarse_scene(folder, clip)

            folder = prepare_folder(Path(source), out, config or RunConfig(), first)
            ahead.wait()
        folder.count_from(begun)
        try:
            train(folder)
            metrics = render_run(folder)
        finally:
            folder.save()
    if is_new and not ahead.compiled and watch.was_quiet():
        Speed(folder.config.device).remember(folder.seconds, estimate_seconds(Scene(folder.scene_path), folder.config))
    return metrics


def load(path: Path | str, device: str = "cpu") -> SceneModel:
    """Return the trained scene of a run: ``load("out").render(camera, t)`` gives arrays.

    Where the run was fitted to its held-out frames, too (``model_all_frames/``), it is that model; the measured one is
    ``load("out/model")``.

    Args:
        path: of the run, or of one of its models.
        device: what renders it: auto, cpu or cuda.

    Raises:
        InputError: there is none, it is damaged or of a scene that was prepared anew since, or the device does not work.

    Examples:
        >>> model = flowsplat.load("out/clip")
        >>> model.first, round(model.last, 2)
        (0.0, 1.83)
    """
    path = resolve_run(Path(path))
    run = RunPaths(path)
    if run.record_path.exists() and has_model(run.all_frames_path):
        path = run.all_frames_path
    elif (run.model_path / "model.json").exists():
        path = run.model_path
    elif not (path / "model.json").exists():
        raise InputError(f"{path} holds no trained scene yet: run flowsplat train on it first.")
    model = load_model(path).to(pick_device(device))
    scene = _find_scene(run if run.record_path.exists() else RunPaths(path.parent))
    if scene is None:
        return model
    check_scene(path, model, scene)
    return replace(model, viewpoint=_middle_of(scene))


def one_color_of(path: Path) -> Callable[[], SceneModel] | None:
    """Return what makes the model of a run for formats with one color a Gaussian (``fitting.one_color_model``); None where the
    folder is none of a run."""
    return (lambda: one_color_model(RunFolder(path))) if RunPaths(path).record_path.exists() else None


def _find_scene(run: RunPaths) -> Scene | None:
    """Return the scene of a run; None where it has none that can be read."""
    try:
        return Scene(run.scene_path)
    except InputError:
        return None


def _middle_of(scene: Scene) -> tuple[Camera, float] | None:
    """Camera and time of the middle frame of a scene; None where its cameras cannot be read."""
    try:
        middle = scene.num_frames // 2
        return scene.cameras[middle], float(scene.timestamps[middle])
    except InputError:
        return None


# -- evaluate


class _Result:
    """The trained scene of a run and what its report shows of it, each read or rendered when first asked for, and then kept."""

    def __init__(self, folder: RunFolder):
        self._folder = folder

    @cached_property
    def model(self) -> SceneModel:
        """What is measured."""
        return load(self._folder.model_path, self._folder.config.device)

    @cached_property
    def scene(self) -> Scene:
        return Scene(self._folder.scene_path)

    @cached_property
    def flows(self) -> list[FlowComparison]:
        return list(flow_comparisons(self.scene, self.model))


def evaluate_run(folder: RunFolder, lpips: Path | None = None) -> dict[str, Any]:
    """Measure the trained scene; writes ``metrics.json`` and the report.

    Args:
        lpips: a file of AlexNet's weights, by which LPIPS is measured, too; what is measured already is measured again.

    Raises:
        InputError: there is no trained scene with the settings of the run, the device does not work, or as
            ``lpips_network.open_lpips``.
    """
    perceptual = None if lpips is None else open_lpips(lpips)
    with lease(folder.path):
        return _evaluate(folder, _Result(folder), perceptual)


def _evaluate(folder: RunFolder, result: _Result, perceptual: PerceptualMetric | None = None) -> dict[str, Any]:
    pick_device(folder.config.device)
    if folder.model_path.exists() and not is_trained(folder):
        raise InputError(f"{folder.model_path} was trained with other settings than those of the run: run flowsplat train first.")
    key = stage_key(train_key(folder), folder.config.baselines, folder.config.refine_poses)
    if folder.is_finished("evaluate", key) and folder.metrics_path.exists() and perceptual is None:
        return read_metrics(folder.metrics_path)
    static = static_model(folder) if folder.config.baselines == "all" else None
    with folder.stage("evaluate", key, made=False) as stage:
        metrics = _measure(folder, result, static, perceptual)
        _write_metrics(folder, result, metrics, stage.seconds)
        stage.finish()
    return metrics


def _measure(folder: RunFolder, result: _Result, static: SceneModel | None, perceptual: PerceptualMetric | None) -> dict[str, Any]:
    model, scene = result.model, result.scene
    refine = partial(refine_camera, model) if folder.config.refine_poses else None
    metrics = evaluate(model, scene, folder=folder.evaluation_path, static_model=static, refine=refine, perceptual=perceptual)
    counts = [model.active_count(float(t)) for t in scene.timestamps]
    metrics["gaussians"] = {
        "total": len(model.gaussians), "active_mean": float(np.mean(counts)), "active": counts,
        "objects": {str(number): count for number, count in model.gaussians.object_counts.items()},
    }  # fmt: skip
    metrics["objects"] = object_figures(scene, load_objects(scene))
    return metrics


def _write_metrics(folder: RunFolder, result: _Result, metrics: dict[str, Any], seconds: Mapping[str, float]) -> None:
    """Complete ``metrics``, and write them and the report. A stage that took ``seconds`` is finished only when that is done."""
    metrics["peak_memory_gib"] = folder.peak_memory
    metrics["memory_gib"] = {**folder.memory, **dict.fromkeys(seconds, get_recent_peak())}
    metrics["seconds"], metrics["wall_seconds"] = {**folder.seconds, **seconds}, folder.wall_seconds
    metrics["orbit"] = read_swing(folder.renders_path)
    metrics["measured"] = folder.model_path.name
    metrics["shown"] = (folder.all_frames_path if has_model(folder.all_frames_path) else folder.model_path).name
    write_json(folder.metrics_path, metrics)
    history = read_history(folder.training_path / HISTORY)
    with spinner("Writing report.html"):
        data = report_data(folder.path, folder.record["input"], result.scene, result.flows, metrics, history, folder.config)
        write_report(folder.path, data)


def find_metrics(folder: RunFolder) -> dict[str, Any] | None:
    """Return the figures of the trained scene of a run; None where it was not measured yet, or is trained or prepared anew since.

    Those of settings that an earlier version had count.

    Raises:
        InputError: they are damaged.
    """
    return read_metrics(folder.metrics_path) if folder.is_of_scene("train") and folder.metrics_path.exists() else None


def read_metrics(path: Path) -> dict[str, Any]:
    """Return the figures of an evaluation, as it returned them.

    Raises:
        InputError: missing or damaged.
    """
    metrics: dict[str, Any] = read_json(path, MetricsFile)
    require_keys(path, metrics, "heldout_frames", "gaussians")
    return metrics


def read_history(path: Path) -> list[dict[str, float]]:
    """Return the figures of a training; none where there is no file.

    Raises:
        InputError: damaged.
    """
    entries = read_json(path, list[dict[str, Number | None]], _MAX_HISTORY_BYTES) if path.exists() else []
    if any(entry.get("step") is None for entry in entries):
        raise InputError(f"{path} is damaged: it has figures of no step.")
    return entries


# -- render


def _render_key(folder: RunFolder) -> str:
    """Return a camera file counts by its name, which that of its video has, and by what is in it, not by where it lies.

    Raises:
        InputError: the camera file cannot be read.
    """
    options, file = folder.config.render, folder.config.render.camera_file
    model = final_key(folder) if wants_final(folder) else train_key(folder)
    if file is None:
        return stage_key(model, options)
    content = hash_files("", [("camera_file", file)], whole=True)
    return stage_key(model, replace(options, camera_file=None), name_of(file), content)


def render_run(folder: RunFolder, options: RenderOptions | None = None) -> dict[str, Any]:
    """Render videos of a run and complete its report. Returns the content of ``metrics.json``.

    What is rendered is fitted to the held-out frames, too, after the measurement (``final_fit``).

    Args:
        folder: the run.
        options: which videos, beside those that are there; None = those of the run's own settings.

    Raises:
        InputError: an option or the camera file cannot be used, or as ``evaluate_run``.
    """
    with lease(folder.path):
        return _render(folder, options)


def _render(folder: RunFolder, options: RenderOptions | None) -> dict[str, Any]:
    if is_trained(folder) and not has_model(folder.model_path):
        raise InputError(f"{folder.model_path} is gone: flowsplat train {folder.path} trains it again.")
    result = _Result(folder)
    metrics = _evaluate(folder, result)
    fit_heldout(folder)
    if options is not None and options != folder.config.render:
        _render_videos(folder, result, options)
        _write_metrics(folder, result, metrics, {})
        return metrics
    with folder.stage("render", _render_key(folder), made=are_rendered(folder.renders_path)) as stage:
        if not stage.is_done:
            _render_videos(folder, result, folder.config.render)
            _write_metrics(folder, result, metrics, stage.seconds)
            stage.finish()
    return metrics


def _render_videos(folder: RunFolder, result: _Result, options: RenderOptions) -> None:
    shown = load(folder.path, folder.config.device) if has_model(folder.all_frames_path) else result.model
    render_videos(shown, result.scene, folder.renders_path, options)
