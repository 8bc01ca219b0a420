"""The stages of a run that fit Gaussians to its scene: training, the static scene that it is compared with, and the final fit."""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from flowsplat.common.devices import pick_device
from flowsplat.common.errors import InputError
from flowsplat.common.files import lease, remove_partials, write_json
from flowsplat.common.memory import give_back_memory
from flowsplat.common.progress import report, spinner
from flowsplat.common.settings import to_plain
from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.observations import Observation, Observations, load_observations
from flowsplat.gaussians.render import RenderedFrame
from flowsplat.gaussians.shadows import add_shadow_free
from flowsplat.gaussians.visibility import with_seen
from flowsplat.images.colors import float_to_bytes
from flowsplat.images.sheets import preview_sheet
from flowsplat.output.videos import forget_videos
from flowsplat.pipeline.config import check
from flowsplat.pipeline.folder import RunFolder, Stage, stage_key
from flowsplat.priors.heldout import heldout_flow
from flowsplat.priors.kinds.flow import flow_estimator
from flowsplat.scenes import Scene, Tracks
from flowsplat.scenes.layers import Layers, write_image
from flowsplat.training.checkpoint import fits_scene, has_model, load_model, save_model
from flowsplat.training.clip_length import adapt_to_length
from flowsplat.training.config import TrainConfig, select_result_settings
from flowsplat.training.final import final_config, final_visits, with_heldout
from flowsplat.training.one_color import one_color_config
from flowsplat.training.scene_model import scene_model
from flowsplat.training.static import static_config, static_start
from flowsplat.training.trainer import Trainer

Begin = Callable[[Observations, Tracks | None, TrainConfig], Gaussians4D]
Observe = Callable[[Scene], Observations]


HISTORY = "history.json"
"""Of a training, beside its checkpoints."""


def train_key(folder: RunFolder) -> str:
    """Return what a trained scene belongs to: the prepared scene, and the settings of training that change the result."""
    settings = to_plain(folder.config.train)
    return stage_key(folder.record["stages"].get("prepare", {}).get("key"), select_result_settings(settings))


def is_trained(folder: RunFolder) -> bool:
    """Return whether the model of a run is of its scene and of its settings as this version reads them."""
    return folder.is_finished("train", train_key(folder))


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
    key = train_key(folder)
    model = load_model(folder.model_path) if is_trained(folder) and has_model(folder.model_path) else None
    if model is not None and not fits_scene(model, Scene(folder.scene_path)):
        folder.forget("train")  # the scene was prepared anew with the same settings, by another version or machine say
    if not is_trained(folder) and not folder.was_started("train", key):
        if folder.model_path.exists() or folder.training_path.exists():
            report("The settings of training, or the scene, are others than before: it begins anew.")
        forget_videos(folder.renders_path)
    owns = (
        folder.training_path, folder.logs_path, folder.all_frames_path, folder.one_color_path, folder.model_path,
        folder.metrics_path, folder.report_path, folder.evaluation_path,
    )  # fmt: skip
    drops = ("all_frames", "one_color", "evaluate", "render")
    with folder.stage("train", key, owns, drops, made=has_model(folder.model_path)) as stage:
        if stage.is_done:
            assert model is not None
            return model.to(pick_device(folder.config.device))
        return _train_in(folder, stage, "train", resolve_train_config(folder), folder.training_path, folder.model_path)


def resolve_train_config(folder: RunFolder) -> TrainConfig:
    """Return the settings of training as they are for the prepared clip of a run, which may be a long one."""
    return adapt_to_length(folder.config.train, Scene(folder.scene_path).num_frames)


def _drop_checkpoints(path: Path) -> None:
    for checkpoint in path.glob("*step_*.safetensors"):  # those that were never finished, too
        checkpoint.unlink()
    (path / "latest.json").unlink(missing_ok=True)


def _train_in(
    folder: RunFolder, stage: Stage, name: str, config: TrainConfig, where: Path, model_path: Path, begin: Begin | None = None,
    observe: Observe = load_observations, first_step: int = 0, visits: Sequence[int] | None = None,
) -> SceneModel:  # fmt: skip
    """Train in the folder ``where``, from the last checkpoint there if there is one, save the scene, and finish the stage.

    Args:
        name: of the stage.
        begin: makes the Gaussians to start from; None = as ``initialize``.
        observe: gives the frames to train on.
        first_step: how many steps those of ``begin`` have behind them.
        visits: how often each frame is drawn in a round; None = once.
    """
    scene = Scene(folder.scene_path)
    with spinner("Loading frames and priors"):
        tracks, observations = scene.tracks if scene.has_tracks else None, observe(scene)

    def preview(step: int, frame: Observation, rendered: RenderedFrame) -> None:
        image = rendered.color.detach().clamp(0, 1).cpu().numpy()
        write_image(folder.preview_path, preview_sheet(frame.image, float_to_bytes(image)))

    start = None if begin is None else begin(observations, tracks, config)
    shown = preview if begin is None else None  # the image of a run is that of its scene, not of what it is compared with
    device = pick_device(folder.config.device)
    with _open_event_log(folder.logs_path / where.name) as record:
        trainer = Trainer(observations, tracks, config, where, shown, record, start, device, first_step, visits)
        model = scene_model(scene, trainer.run(), config)
        earlier = trainer.state.earlier_seconds
        history = trainer.history
    del trainer, observations, tracks, start  # What it was trained with is larger than the model.
    give_back_memory()
    if begin is not static_start:
        with spinner("Finding what the clip has seen of the scene"):
            model = with_seen(model, scene.cameras, scene.timestamps.tolist())
            of = scene.train_frames
            seconds = [float(scene.timestamps[i]) for i in of]
            model = add_shadow_free(model, [scene.cameras[i] for i in of], seconds, [scene.mask(i) for i in of])
    save_model(model_path, model)
    write_json(where / HISTORY, history)
    stage.finish({name: earlier + stage.seconds[name]})
    _drop_checkpoints(where)
    return model


@contextlib.contextmanager
def _open_event_log(folder: Path) -> Iterator[Callable[[Mapping[str, float]], None]]:
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


def static_model(folder: RunFolder) -> SceneModel:
    """Our own static scene: initial Gaussians as of the moving one (as many as may stay), objects as in their middle frame, no
    motion, a quarter of the steps."""
    path, key = folder.static_path, stage_key(train_key(folder), "static")
    with folder.stage("static", key, (path,), made=has_model(path)) as stage:
        if stage.is_done:
            return load_model(path).to(pick_device(folder.config.device))
        config = static_config(resolve_train_config(folder))
        report("Training the static scene for comparison.")
        quarter = replace(config, iterations=max(1, config.iterations // 4))
        return _train_in(folder, stage, "static", quarter, path, path, static_start)


# -- the final fit


def wants_final(folder: RunFolder) -> bool:
    """Return whether the run asks for a fit to the held-out frames, and has any."""
    return folder.config.final_fit and bool(Scene(folder.scene_path).heldout_frames)


def final_key(folder: RunFolder) -> str:
    """Return what the final fit belongs to."""
    return stage_key(train_key(folder), "all_frames")


def fit_heldout(folder: RunFolder) -> None:
    """Bring ``model_all_frames/`` to what the run asks for: the measured model, fitted to the held-out frames, too; or nothing.

    It begins when everything was measured, and writes nothing that the measurement, the priors or the training read.
    """
    if not wants_final(folder):
        if folder.all_frames_path.exists():
            folder.forget("all_frames")
            shutil.rmtree(folder.all_frames_path)
        return
    path = folder.all_frames_path
    with folder.stage("all_frames", final_key(folder), (path,), made=has_model(path)) as stage:
        if not stage.is_done:
            _fit_heldout(folder, stage)


def _fit_heldout(folder: RunFolder, stage: Stage) -> None:
    scene, config = Scene(folder.scene_path), folder.config
    report(f"Fitting the {len(scene.heldout_frames)} held-out frames, too, for what is shown: they are measured already.")

    def observe(scene: Scene) -> Observations:
        if config.train.loss.flow > 0:
            heldout_flow(scene, _heldout_layers(folder, scene), flow_estimator(config.priors, config.device))
        return _observe_all(folder, scene)

    def begin(observations: Observations, tracks: Tracks | None, train: TrainConfig) -> Gaussians4D:
        return load_model(folder.model_path).gaussians

    settings, first_step = final_config(resolve_train_config(folder), len(scene.heldout_frames))
    _train_in(
        folder, stage, "all_frames", settings, folder.all_frames_path, folder.all_frames_path, begin, observe, first_step,
        final_visits(scene),
    )  # fmt: skip


def _heldout_layers(folder: RunFolder, scene: Scene) -> Layers:
    return Layers(folder.all_frames_path / "priors", scene.width, scene.height)


def _observe_all(folder: RunFolder, scene: Scene) -> Observations:
    return with_heldout(load_observations(scene), scene, _heldout_layers(folder, scene))


# -- formats with one color a Gaussian


def one_color_model(folder: RunFolder) -> SceneModel:
    """Return the model that is shown, fitted without slopes of brightness; made where it is not there yet.

    Raises:
        InputError: there is no trained scene with the settings of the run, or as ``lease``.
    """
    with lease(folder.path):
        is_final = has_model(folder.all_frames_path) and wants_final(folder) and folder.is_finished("all_frames", final_key(folder))
        if not is_trained(folder):
            raise InputError(f"{folder.path} holds no scene that was trained with its settings: run flowsplat train on it first.")
        key = stage_key(final_key(folder) if is_final else train_key(folder), "one_color")
        path = folder.one_color_path
        with folder.stage("one_color", key, (path,), made=has_model(path)) as stage:
            if stage.is_done:
                return load_model(path)
            report("Fitting the scene to one color for each Gaussian, as the format has it. It is kept for the next time.")

            def begin(observations: Observations, tracks: Tracks | None, train: TrainConfig) -> Gaussians4D:
                return load_model(folder.all_frames_path if is_final else folder.model_path).gaussians.without_slopes()

            def observe(scene: Scene) -> Observations:
                return _observe_all(folder, scene) if is_final else load_observations(scene)

            settings, first_step = one_color_config(resolve_train_config(folder))
            model = _train_in(folder, stage, "one_color", settings, path, path, begin, observe, first_step)
        folder.save()
        return model.to("cpu")
