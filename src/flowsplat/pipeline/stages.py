"""The stages of a run. Each can be called alone; each does nothing where it is finished, and continues where it was stopped."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.devices import pick_device
from flowsplat.common.errors import InputError
from flowsplat.common.files import hash_files, lease, read_json, remove_partials, require_keys, write_json
from flowsplat.common.files.json_file import Number
from flowsplat.common.files.lease import NAME as LOCK
from flowsplat.common.files.writing import writing_error
from flowsplat.common.memory import begin_peak, recent_peak
from flowsplat.common.progress import busy, say
from flowsplat.common.settings import to_plain
from flowsplat.evaluation.evaluate import evaluate
from flowsplat.evaluation.poses import refine_camera
from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.observations import Observation, Observations, load_observations
from flowsplat.gaussians.render import RenderedFrame
from flowsplat.gaussians.shadows import with_lit
from flowsplat.gaussians.support import with_seen
from flowsplat.output.priors_report import verdict, write_priors_report
from flowsplat.output.report import FlowComparison, write_report
from flowsplat.output.videos import RenderOptions, are_rendered, forget_videos, name_of, render_videos, settle
from flowsplat.pictures.colors import float_to_bytes
from flowsplat.pictures.sheets import preview_sheet
from flowsplat.pipeline.compiling import compiling_ahead
from flowsplat.pipeline.config import RunConfig, check
from flowsplat.pipeline.first import first_scene, is_worth_it
from flowsplat.pipeline.folder import MetricsFile, RunFolder, stage_key
from flowsplat.pipeline.speed import STAGES, Range, Speed, expected, expected_memory, expected_of, in_words
from flowsplat.pipeline.summary import flow_comparisons, report_data
from flowsplat.priors.heldout import heldout_flow
from flowsplat.priors.objects import load_movers
from flowsplat.priors.objects.description import mover_figures
from flowsplat.priors.prepare import check_places, flow_estimator, names_places, prepare_priors
from flowsplat.scenes import Scene, Tracks
from flowsplat.scenes.clip import Clip, InputOptions
from flowsplat.scenes.ingest import CALIBRATED, fingerprint, ingest, is_ingested, kind_of_input, open_clip
from flowsplat.scenes.layers import Layers, write_image
from flowsplat.training.checkpoint import has_model, load_model, present_figures, save_model
from flowsplat.training.config import TrainConfig, affecting_result
from flowsplat.training.final import final_config, final_visits, with_heldout
from flowsplat.training.scene_model import scene_model
from flowsplat.training.static import static_config, static_start
from flowsplat.training.trainer import Trainer

_BROUGHT = ("given", "truth", CALIBRATED)
"""Methods of priors that cost no time."""
_MOST_HISTORY = 64 * 2**20
ASIDE = ".scene.before"
"""Where the scene of other settings waits until that of the new ones is there."""

Begin = Callable[[Observations, Tracks | None, TrainConfig], Gaussians4D]
Observe = Callable[[Scene], Observations]


def run(source: Path, out: Path, config: RunConfig | None = None) -> dict[str, Any]:
    """The whole way: a clip becomes a 4D scene, pictures and figures. Called again, it continues.

    Args:
        source: a video, a folder of pictures (or with images/ and masks/), a DAVIS root, a rig scene, an NVIDIA Dynamic Scene
            or a prepared scene.
        out: folder of the run.
        config: every setting; None = the default preset.

    Returns:
        the content of ``metrics.json``.

    Raises:
        InputError: the input, a setting or the folder cannot be used.
    """
    is_new = not (Path(out) / "run.json").exists()
    with lease(out):
        device = pick_device((config or RunConfig()).device).type
        with compiling_ahead(device) as ahead:

            def first(folder: RunFolder, clip: Clip) -> None:
                # Kernels that are still being compiled are waited for once, after the priors.
                if folder.config.first_scene and not ahead.is_busy and is_worth_it(sum(expected_of(clip, folder.config).values())):
                    first_scene(folder, clip)

            folder = _prepared(Path(source), out, config or RunConfig(), first)
            ahead.wait()
        train(folder)
        metrics = render_run(folder)
    if is_new:
        Speed(folder.config.device).remember(folder.seconds, expected(Scene(folder.scene_path), folder.config))
    return metrics


def load(path: Path | str, device: str = "cpu") -> SceneModel:
    """The trained scene of a run: ``load("out").render(camera, t)`` gives arrays.

    Where the run was fitted to its held-out frames, too (``final/``), it is that model; the measured one is ``load("out/model")``.

    Args:
        path: of the run, or of one of its models.
        device: what renders it: auto, cpu or cuda.

    Raises:
        InputError: there is none, it is damaged, or the device does not work.
    """
    path = Path(path)
    if (path / "run.json").exists() and has_model(path / "final"):
        path = path / "final"
    elif (path / "model" / "model.json").exists():
        path = path / "model"
    elif not (path / "model.json").exists():
        raise InputError(f"{path} holds no trained scene yet: run flowsplat train on it first.")
    return load_model(path).to(pick_device(device))


# -- prepare


def prepare(source: Path, out: Path, config: RunConfig | None = None) -> RunFolder:
    """Bring the input into a scene folder and compute what is missing of its priors.

    Raises:
        InputError: the input, a setting or a given file cannot be used, and then ``out`` stays as it was; or as ``lease``.
    """
    with lease(out):
        return _prepared(Path(source), out, config or RunConfig())


def _prepared(source: Path, out: Path, config: RunConfig, first: Callable[[RunFolder, Clip], None] | None = None) -> RunFolder:
    """As ``prepare``; ``first`` is called with the opened clip before anything is computed of it."""
    check(config)
    kind = kind_of_input(source)
    identity = stage_key(kind, _scene_identity(source) if kind == "scene" else fingerprint(source, config.input))
    is_new, clip = not (Path(out) / "run.json").exists(), None
    if kind == "scene":
        Scene(source)
        if config.input != InputOptions():
            say(f"{source} is prepared already: what options or the preset take from a clip has no effect on it.")
    elif is_new:
        clip = open_clip(source, config.input)  # Whatever is wrong with it is said before a folder is made.
    before = {} if is_new else RunFolder(out).record
    if not is_new:
        remove_partials(out)
    folder = RunFolder.open_or_create(out, str(source), identity, config)
    key = stage_key(identity, config.priors, hash_files("", config.priors.given.files()))
    if folder.is_finished("prepare", key):
        return folder
    show: Callable[[], None] | None = None
    if first is not None and kind != "scene" and not has_model(folder.path / "model"):
        opened = clip or open_clip(source, config.input)
        show = functools.partial(first, folder, opened)
    goes_on = is_new or folder.was_started("prepare", key)
    with contextlib.nullcontext() if goes_on else _put_aside(folder, before):
        folder.start("prepare", key)
        _compute_scene(folder, source, kind, key, is_new, show)
    shutil.rmtree(folder.path / ASIDE, ignore_errors=True)
    return folder


@contextlib.contextmanager
def _put_aside(folder: RunFolder, before: Mapping[str, Any]) -> Iterator[None]:
    """The scene of other settings makes room for a new one, and comes back where that turns out to be impossible.

    Args:
        before: the record of the run with those settings.
    """
    if "prepare" in before["started"]:
        say("The settings of the priors, or the files given for them, changed: they are computed again.")
    aside = folder.path / ASIDE
    folder.forget("prepare")
    shutil.rmtree(aside, ignore_errors=True)
    if folder.scene_path.exists():
        folder.scene_path.rename(aside)
    try:
        yield
    except InputError:
        if aside.exists():
            shutil.rmtree(folder.scene_path, ignore_errors=True)
            aside.rename(folder.scene_path)
            write_json(folder.path / "run.json", before)
        raise


def _compute_scene(
    folder: RunFolder, source: Path, kind: str, key: str, is_new: bool, show: Callable[[], None] | None = None
) -> None:
    """Fill the scene of a run: what the input holds, then the priors that it lacks.

    Args:
        show: makes a first scene: before the clip is read, which takes long where that is long, unless a setting can be wrong that
            only the read clip tells; that is said first.
    """
    config = folder.config
    tells = config.render != RenderOptions() or names_places(config.priors)
    if show is not None and not tells:
        show()
    started = time.perf_counter()
    try:
        scene = _read_input(source, kind, folder.scene_path, config)
        settle(scene, config.render)  # Whatever is wrong with the videos is said before minutes of other work.
        check_places(scene, config.priors)
    except InputError:
        if is_new:
            _clear(folder.path)
        raise
    for note in scene.info["notes"]:
        say(note)
    speed, reference = Speed(config.device), expected(scene, config)
    _say_estimate(scene, speed.estimate(reference))
    ingested = time.perf_counter() - started
    if show is not None and tells:
        show()

    memory: dict[str, float | None] = {}

    def after(stage: str, took: float) -> None:
        memory[stage] = recent_peak()
        begin_peak()
        if stage == "cameras":
            speed.seen(took / reference["cameras"])
            say(f"Left of a whole run: {in_words(speed.estimate(reference, STAGES[1:]))}.")

    had = set(scene.info["priors"])
    try:
        seconds = prepare_priors(scene, config.priors, config.device, after)
    except InputError:
        if is_new and all(name in had or how.get("method") in _BROUGHT for name, how in scene.info["priors"].items()):
            _clear(folder.path)
        raise
    with busy("Writing priors.html"):
        page = write_priors_report(folder.path, scene, seconds)
    say(f"{verdict(scene)} Look at {page}")
    folder.finish("prepare", key, {"ingest": ingested, **seconds}, memory)


def _clear(out: Path) -> None:
    """Take everything out of a folder of a run that nothing was computed for; it goes with its lease where it was made for it."""
    for entry in out.iterdir():
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry, ignore_errors=True)
        elif entry.name != LOCK:
            entry.unlink(missing_ok=True)


def _read_input(source: Path, kind: str, target: Path, config: RunConfig) -> Scene:
    """The scene folder with everything of the input in it, as far as it is not there yet."""
    if kind == "scene":
        return copy_scene(source, target)
    if (target / "scene.json").exists() and is_ingested(Scene(target)):
        return Scene(target)
    return ingest(open_clip(source, config.input), target, config.input)


def _scene_identity(source: Path) -> str:
    info = Scene(source).info
    return stage_key({name: info[name] for name in ("name", "source", "width", "height", "timestamps", "train")})


def copy_scene(source: Path, target: Path) -> Scene:
    """Link a prepared scene's files into another folder: every later write replaces a file, so the original stays as it is.

    Raises:
        InputError: the folder cannot be written, or the scene holds links.
    """
    if not (target / "scene.json").exists():
        link_files(source, target)
    return Scene(target)


def link_files(source: Path, target: Path) -> None:
    """A folder with the same files as another one, linked where the file system can; it is there when all of them are.

    Raises:
        InputError: the folder cannot be written, or the other one holds links: what they lead to would come along.
    """

    def link(origin: str, destination: str) -> None:
        try:
            os.link(origin, destination)
        except OSError:
            try:
                shutil.copy2(origin, destination)
            except OSError as error:  # the first one says enough
                raise writing_error(error, Path(destination)) from error

    def refuse_links(folder: str, names: list[str]) -> list[str]:
        for path in (Path(folder) / name for name in names):
            if path.is_symlink() or not (path.is_file() or path.is_dir()):
                raise InputError(f"{path} is a link or no ordinary file: a scene holds its files itself.")
        return []

    partial = target.with_name(f".{target.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        shutil.copytree(source, partial, copy_function=link, ignore=refuse_links)
        partial.rename(target)
    except OSError as error:
        raise InputError(f"Cannot copy {source} to {target}: {error.strerror or error}.") from error


def _say_estimate(scene: Scene, seconds: Range) -> None:
    gib = expected_memory(scene.width, scene.height, len(scene.train_frames))
    say(
        f"{scene.num_frames} frames of {scene.width} x {scene.height}, {len(scene.heldout_frames)} of them held out: "
        f"{in_words(seconds)} and {gib:.1f} GiB for a whole run."
    )


# -- train


def _train_key(folder: RunFolder) -> str:
    settings = to_plain(folder.config.train, first_names=True)
    return stage_key(folder.record["stages"].get("prepare", {}).get("key"), affecting_result(settings))


def train(folder: RunFolder) -> SceneModel:
    """Train the scene of a run, from its last checkpoint if there is one.

    Raises:
        InputError: the scene is not prepared, something in it is damaged, or the device does not work; or as ``lease``.
    """
    with lease(folder.path):
        return _train(folder)


def _train(folder: RunFolder) -> SceneModel:
    remove_partials(folder.path)
    if "prepare" not in folder.record["stages"]:
        raise InputError(f"{folder.path} is not prepared yet: run flowsplat prepare first.")
    check(folder.config)  # before anything is deleted
    key = _train_key(folder)
    if folder.is_finished("train", key) and has_model(folder.model_path):
        return load_model(folder.model_path).to(pick_device(folder.config.device))
    if not folder.was_started("train", key):
        if folder.model_path.exists() or (folder.path / "training").exists():
            say("The settings of training, or the scene, are others than before: it begins anew.")
        folder.forget("train")
        folder.forget("final")
        for old in ("training", "logs", "final", "model"):
            shutil.rmtree(folder.path / old, ignore_errors=True)
        forget_videos(folder.path / "renders")
        folder.start("train", key)
    return _trained(folder, "train", key, folder.config.train, "training", folder.model_path)


def _drop_checkpoints(path: Path) -> None:
    for checkpoint in path.glob("*step_*.safetensors"):  # those that were never finished, too
        checkpoint.unlink()
    (path / "latest.json").unlink(missing_ok=True)


def _trained(
    folder: RunFolder, stage: str, key: str, config: TrainConfig, where: str, model_path: Path, begin: Begin | None = None,
    observe: Observe = load_observations, first_step: int = 0, visits: Sequence[int] | None = None,
) -> SceneModel:  # fmt: skip
    """Train in the folder ``where`` of a run, from the last checkpoint there if there is one, and save the scene.

    Args:
        begin: makes the Gaussians to start from; None = as ``initialize``.
        observe: gives the frames to train on.
        first_step: how many steps those of ``begin`` have behind them.
        visits: how often each frame is drawn in a round; None = once.
    """
    started, out, scene = time.perf_counter(), folder.path, Scene(folder.scene_path)
    with busy("Loading frames and priors"):
        tracks, observations = scene.tracks if scene.has_tracks else None, observe(scene)
    def preview(step: int, frame: Observation, rendered: RenderedFrame) -> None:
        image = rendered.colour.detach().clamp(0, 1).cpu().numpy()
        write_image(out / "preview.png", preview_sheet(frame.image, float_to_bytes(image)))

    start = None if begin is None else begin(observations, tracks, config)
    shown = preview if begin is None else None  # the picture of a run is that of its scene, not of what it is compared with
    device = pick_device(folder.config.device)
    with _event_log(out / "logs" / where) as record:
        trainer = Trainer(observations, tracks, config, out / where, shown, record, start, device, first_step, visits)
        model = scene_model(scene, trainer.run(), config)
        earlier = trainer.earlier_seconds
        history = trainer.history
        del trainer  # What it trained with is as large as the model.
    if begin is not static_start:
        with busy("Finding what the clip has seen of the scene"):
            model = with_seen(model, scene.cameras, scene.timestamps.tolist())
            of = scene.train_frames
            seconds = [float(scene.timestamps[i]) for i in of]
            model = with_lit(model, [scene.cameras[i] for i in of], seconds, [scene.mask(i) for i in of])
    save_model(model_path, model)
    write_json(out / where / "history.json", history)
    folder.finish(stage, key, {stage: earlier + time.perf_counter() - started})
    _drop_checkpoints(out / where)
    return model


@contextlib.contextmanager
def _event_log(folder: Path) -> Iterator[Callable[[Mapping[str, float]], None]]:
    """Takes what training records and writes it for TensorBoard.

    Its thread raises what it could not write with the next figure, too: there it is a line, in the thread a traceback.
    """
    from torch.utils.tensorboard import SummaryWriter

    def record(entry: Mapping[str, float]) -> None:
        for figure, value in entry.items():
            if figure != "step":
                writer.add_scalar(figure, value, int(entry["step"]))

    def of_thread(failure: threading.ExceptHookArgs) -> None:
        if not issubclass(failure.exc_type, OSError):
            before(failure)

    before, threading.excepthook = threading.excepthook, of_thread
    try:
        with contextlib.closing(SummaryWriter(str(folder))) as writer:
            yield record
    finally:
        threading.excepthook = before


def _static_model(folder: RunFolder) -> SceneModel:
    """Our own static scene: the same initial Gaussians, movers as in their middle frame, no motion, a quarter of the steps."""
    path = folder.path / "static"
    key = stage_key(_train_key(folder), "static")
    if folder.is_finished("static", key) and has_model(path):
        return load_model(path).to(pick_device(folder.config.device))
    if not folder.was_started("static", key):
        folder.forget("static")
        shutil.rmtree(path, ignore_errors=True)
        folder.start("static", key)
    config = static_config(folder.config.train)
    say("Training the static scene for comparison.")
    quarter = replace(config, iterations=max(1, config.iterations // 4))
    return _trained(folder, "static", key, quarter, "static", path, static_start)


# -- the final fit


def _wants_final(folder: RunFolder) -> bool:
    return folder.config.final_fit and bool(Scene(folder.scene_path).heldout_frames)


def _final_key(folder: RunFolder) -> str:
    return stage_key(_train_key(folder), "final")


def _fit_heldout(folder: RunFolder) -> None:
    """Bring ``final/`` to what the run asks for: the measured model, fitted to the held-out frames, too; or nothing.

    It begins when everything was measured, and writes nothing that the measurement, the priors or the training read.
    """
    if not _wants_final(folder):
        if folder.final_path.exists():
            folder.forget("final")
            shutil.rmtree(folder.final_path)
        return
    key = _final_key(folder)
    if folder.is_finished("final", key) and has_model(folder.final_path):
        return
    if not folder.was_started("final", key):
        folder.forget("final")
        shutil.rmtree(folder.final_path, ignore_errors=True)
        folder.start("final", key)
    scene, config = Scene(folder.scene_path), folder.config
    say(f"Fitting the {len(scene.heldout_frames)} held-out frames, too, for what is shown: they are measured already.")

    def observe(scene: Scene) -> Observations:
        layers = Layers(folder.final_path / "priors", scene.width, scene.height)
        if config.train.loss.flow > 0:
            heldout_flow(scene, layers, flow_estimator(config.priors, config.device))
        return with_heldout(load_observations(scene), scene, layers)

    def begin(observations: Observations, tracks: Tracks | None, train: TrainConfig) -> Gaussians4D:
        return load_model(folder.model_path).gaussians

    _trained(
        folder, "final", key, final_config(config.train), "final", folder.final_path, begin,
        observe, config.train.iterations, final_visits(scene),
    )  # fmt: skip


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


def evaluate_run(folder: RunFolder) -> dict[str, Any]:
    """Measure the trained scene; writes ``metrics.json`` and the report.

    Raises:
        InputError: there is no trained scene with the settings of the run, or the device does not work.
    """
    with lease(folder.path):
        return _evaluate(folder, _Result(folder))


def _evaluate(folder: RunFolder, result: _Result) -> dict[str, Any]:
    pick_device(folder.config.device)
    if folder.model_path.exists() and not folder.is_finished("train", _train_key(folder)):
        raise InputError(f"{folder.model_path} was trained with other settings than those of the run: run flowsplat train first.")
    key = stage_key(_train_key(folder), folder.config.baselines, folder.config.refine_poses)
    metrics_path = folder.path / "metrics.json"
    if folder.is_finished("evaluate", key) and metrics_path.exists():
        return read_metrics(metrics_path)
    model, scene = result.model, result.scene
    static = _static_model(folder) if folder.config.baselines == "all" else None
    folder.start("evaluate", key)
    started = time.perf_counter()
    refine = partial(refine_camera, model) if folder.config.refine_poses else None
    metrics = evaluate(model, scene, folder=folder.path / "evaluation", static_model=static, refine=refine)
    counts = [model.active_count(float(t)) for t in scene.timestamps]
    metrics["gaussians"] = {
        "total": len(model.gaussians), "active_mean": float(np.mean(counts)), "active": counts,
        "movers": {str(number): count for number, count in model.gaussians.mover_counts.items()},
    }  # fmt: skip
    metrics["movers"] = mover_figures(scene, load_movers(scene))
    seconds = {"evaluate": time.perf_counter() - started}
    _write_metrics(folder, result, metrics, seconds)
    folder.finish("evaluate", key, seconds)
    return metrics


def _write_metrics(folder: RunFolder, result: _Result, metrics: dict[str, Any], seconds: Mapping[str, float]) -> None:
    """Complete ``metrics``, and write them and the report. A stage that took ``seconds`` is finished only when that is done."""
    metrics["peak_memory_gib"] = folder.peak_memory
    metrics["memory_gib"] = {**folder.memory, **dict.fromkeys(seconds, recent_peak())}
    metrics["seconds"] = {**folder.seconds, **seconds}
    metrics["measured"] = folder.model_path.name
    metrics["shown"] = (folder.final_path if has_model(folder.final_path) else folder.model_path).name
    write_json(folder.path / "metrics.json", metrics)
    history = read_history(folder.path / "training" / "history.json")
    with busy("Writing report.html"):
        data = report_data(folder.path, result.scene, result.flows, metrics, history, folder.config)
        write_report(folder.path, data)


def read_metrics(path: Path) -> dict[str, Any]:
    """The figures of an evaluation, as it returned them.

    Raises:
        InputError: missing or damaged.
    """
    metrics: dict[str, Any] = read_json(path, MetricsFile)
    require_keys(path, metrics, "heldout_frames", "gaussians")
    return metrics


def read_history(path: Path) -> list[dict[str, float]]:
    """The figures of a training; none where there is no file.

    Raises:
        InputError: damaged.
    """
    entries = read_json(path, list[dict[str, Number | None]], _MOST_HISTORY) if path.exists() else []
    if any(entry.get("step") is None for entry in entries):
        raise InputError(f"{path} is damaged: it has figures of no step.")
    return present_figures(entries)


# -- render


def _render_key(folder: RunFolder) -> str:
    """A camera file counts by its name, which that of its video has, and by what is in it, not by where it lies.

    Raises:
        InputError: the camera file cannot be read.
    """
    options, file = folder.config.render, folder.config.render.camera_file
    model = _final_key(folder) if _wants_final(folder) else _train_key(folder)
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
        return _rendered(folder, options)


def _rendered(folder: RunFolder, options: RenderOptions | None) -> dict[str, Any]:
    result = _Result(folder)
    metrics = _evaluate(folder, result)
    _fit_heldout(folder)
    own = options is None or options == folder.config.render
    key = _render_key(folder) if own else ""
    if own and folder.is_finished("render", key) and are_rendered(folder.path / "renders"):
        return metrics
    started = time.perf_counter()
    if own:
        folder.start("render", key)
    shown = load(folder.path, folder.config.device) if has_model(folder.final_path) else result.model
    render_videos(shown, result.scene, folder.path / "renders", options or folder.config.render)
    seconds = {"render": time.perf_counter() - started} if own else {}
    _write_metrics(folder, result, metrics, seconds)
    if own:
        folder.finish("render", key, seconds)
    return metrics
