"""The first stage of a run: a clip is brought into a scene folder, and its priors are computed."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from flowsplat.common.devices import pick_device
from flowsplat.common.errors import InputError
from flowsplat.common.files import lease, remove_partials, write_json
from flowsplat.common.files.lease import NAME as LOCK
from flowsplat.common.files.writing import make_writing_error
from flowsplat.common.memory import begin_peak, get_recent_peak, give_back_memory
from flowsplat.common.progress import report, spinner
from flowsplat.common.run_paths import RunPaths
from flowsplat.common.settings import to_plain
from flowsplat.output.priors_report import verdict, write_priors_report
from flowsplat.output.videos import RenderOptions, settle
from flowsplat.pipeline.compiling import are_missing
from flowsplat.pipeline.config import RunConfig, check
from flowsplat.pipeline.folder import RunFolder, Stage, stage_key
from flowsplat.pipeline.left_out import word_left_out
from flowsplat.pipeline.speed import MIN_OWN_SECONDS, STAGES, Speed, TimeEstimate, Watch, estimate_memory, estimate_seconds
from flowsplat.priors.graph import PRIORS
from flowsplat.priors.options import names_places
from flowsplat.priors.prepare import check_places, prepare_priors
from flowsplat.priors.prior import BROUGHT
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import Clip, InputOptions
from flowsplat.scenes.ingest import fingerprint, ingest, kind_of_input, open_clip
from flowsplat.training.checkpoint import has_model

SET_ASIDE = ".scene.before"
"""Where the scene of other settings waits until that of the new ones is there."""


def prepare(source: str | Path, out: str | Path, config: RunConfig | None = None) -> RunFolder:
    """Bring the input into a scene folder and compute what is missing of its priors.

    Raises:
        InputError: the input, a setting or a given file cannot be used, and then ``out`` stays as it was; or as ``lease``.
    """
    out = Path(out)
    with lease(out):
        return prepare_folder(Path(source), out, config or RunConfig())


def find_prepared(source: str | Path, out: str | Path, config: RunConfig) -> Path | None:
    """Return the scene that ``prepare`` made of an input with these settings; None where it is not finished.

    Nothing is written, so that any number of processes may read the same scene, also from a folder that is read-only.

    Raises:
        InputError: the input cannot be used.
    """
    source, out = Path(source), Path(out)
    if not RunPaths(out).record_path.exists():
        return None
    folder, key = RunFolder(out), stage_key(identify(source, config), *PRIORS.inputs(config.priors))
    return folder.scene_path if _is_prepared(folder, key) else None


def identify(source: Path, config: RunConfig) -> str:
    """Return what the run of an input is known by: its kind, its files, and what is taken from it.

    Raises:
        InputError: the input cannot be used.
    """
    return stage_key(kind_of_input(source), fingerprint(source, config.input))


def _is_prepared(folder: RunFolder, key: str) -> bool:
    return folder.is_finished("prepare", key) and (folder.scene_path / "scene.json").exists()


def prepare_folder(source: Path, out: Path, config: RunConfig, first: Callable[[RunFolder, Clip], None] | None = None) -> RunFolder:
    """As ``prepare``; ``first`` is called with the opened clip before anything is computed of it."""
    check(config)
    kind, identity = kind_of_input(source), identify(source, config)
    is_new, clip = not RunPaths(out).record_path.exists(), None
    if kind == "scene":
        Scene(source)
        if config.input != InputOptions():
            report(f"{source} is prepared already: what options or the preset take from a clip has no effect on it.")
    elif is_new:
        clip = open_clip(source, config.input)  # Whatever is wrong with it is said before a folder is made.
    key = stage_key(identity, *PRIORS.inputs(config.priors))
    before: dict[str, Any] = {}
    if not is_new:
        earlier = RunFolder(out)
        before = earlier.record
        if _is_prepared(earlier, key):
            settle(Scene(earlier.scene_path), config.render)  # Whatever is wrong with the videos is said before the training.
        remove_partials(out)
    folder = RunFolder.open_or_create(out, str(source), identity, config)
    if _is_prepared(folder, key):
        return folder
    show: Callable[[], None] | None = None
    if first is not None and kind != "scene" and not has_model(folder.model_path):
        clip = clip or open_clip(source, config.input)
        show = functools.partial(first, folder, clip)
    goes_on = is_new or folder.was_started("prepare", key)
    with contextlib.nullcontext() if goes_on else _set_aside(folder, before), folder.stage("prepare", key, made=False) as stage:
        _compute_scene(folder, stage, source, clip, kind, is_new, show)
    shutil.rmtree(folder.path / SET_ASIDE, ignore_errors=True)
    return folder


@contextlib.contextmanager
def _set_aside(folder: RunFolder, before: Mapping[str, Any]) -> Iterator[None]:
    """The scene of other settings makes room for a new one, and comes back where that turns out to be impossible.

    Args:
        before: the record of the run with those settings.
    """
    if "prepare" in before["started"]:
        old, new = before["config"].get("priors", {}), to_plain(folder.config.priors)
        other = PRIORS.list_depending_on([name for name in new if old.get(name) != new[name]])
        which = f" ({', '.join(other)})" if other else ""
        report(f"The settings of the priors, or the files given for them, changed{which}: they are computed again.")
    aside = folder.path / SET_ASIDE
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
            write_json(folder.record_path, before)
        raise


def _compute_scene(
    folder: RunFolder, stage: Stage, source: Path, clip: Clip | None, kind: str, is_new: bool, show: Callable[[], None] | None
) -> None:
    """Fill the scene of a run: what the input holds, then the priors that it lacks.

    Args:
        clip: what is read, where it is open already.
        show: makes a coarse scene: before the clip is read, which takes long where that is long, unless a setting can be wrong that
            only the read clip tells; that is said first.
    """
    config = folder.config
    tells = config.render != RenderOptions() or names_places(config.priors)
    if show is not None and not tells:
        show()
    started = time.perf_counter()
    try:
        scene = _read_input(source, clip, kind, folder.scene_path, config)
        settle(scene, config.render)  # Whatever is wrong with the videos is said before minutes of other work.
        check_places(scene, config.priors)
    except InputError:
        if is_new:
            _clear(folder.path)
        raise
    for note in scene.info.notes:
        report(note)
    compiling = are_missing(pick_device(config.device).type)
    speed, reference = Speed(config.device), estimate_seconds(scene, config, compiling)
    _report_estimate(scene, speed.estimate(reference), compiling)
    if kind != "scene" and (left_out := word_left_out(scene, config, speed)):
        report(left_out)
    ingested = time.perf_counter() - started
    if show is not None and tells:
        show()

    memory: dict[str, float | None] = {}
    watch, parts = Watch(), {"ingest": ingested}

    def after(prior: str, took: float) -> None:
        memory[prior] = get_recent_peak()
        give_back_memory()
        begin_peak()
        parts[prior] = took
        stage.note(parts)
        if prior == "cameras":
            if took >= MIN_OWN_SECONDS and reference["cameras"] > 0 and watch.was_quiet() and not compiling:
                speed.note(took / reference["cameras"])
            report(f"Left of a whole run: {speed.estimate(reference, STAGES[2:], folder.wall_seconds)}.")

    had = set(scene.info.priors)
    try:
        seconds = prepare_priors(scene, config.priors, config.device, after)
    except InputError:
        if is_new and all(name in had or how.get("method") in BROUGHT for name, how in scene.info.priors.items()):
            _clear(folder.path)
        raise
    with spinner("Writing priors.html"):
        page = write_priors_report(folder.path, scene, seconds)
    report(f"{verdict(scene)} Look at {page}")
    if "depth" in seconds:
        report(f"Left of a whole run: {speed.estimate(reference, STAGES[3:], folder.wall_seconds)}.")
    stage.finish({"ingest": ingested, **seconds}, memory)


def _clear(out: Path) -> None:
    """Take everything out of a folder of a run that nothing was computed for; it goes with its lease where it was made for it."""
    for entry in out.iterdir():
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry, ignore_errors=True)
        elif entry.name != LOCK:
            entry.unlink(missing_ok=True)


def _read_input(source: Path, clip: Clip | None, kind: str, target: Path, config: RunConfig) -> Scene:
    """Return the scene folder with everything of the input in it, as far as it is not there yet."""
    if kind == "scene":
        return copy_scene(source, target)
    if (target / "scene.json").exists() and Scene(target).info.ingested:
        return Scene(target)
    return ingest(clip or open_clip(source, config.input), target, config.input)


def copy_scene(source: Path, target: Path) -> Scene:
    """Link a prepared scene's files into another folder: every later write replaces a file, so the original stays as it is.

    Raises:
        InputError: the folder cannot be written, or the scene holds links.
    """
    if not (target / "scene.json").exists():
        shutil.rmtree(target, ignore_errors=True)  # without its record the rest is no scene
        link_files(source, target)
    return Scene(target)


def link_files(source: Path, target: Path) -> None:
    """A folder with the same files as another one, linked where the file system can; it is there when all of them are.

    Raises:
        InputError: the folder cannot be written or is within the other one, or that holds links: what they lead to would come
            along.
    """
    if target.resolve().is_relative_to(source.resolve()):
        raise InputError(f"{target} is in {source} itself, which is to be copied there: choose another output folder with -o.")

    def link(origin: str, destination: str) -> None:
        try:
            os.link(origin, destination)
        except OSError:
            try:
                shutil.copy2(origin, destination)
            except OSError as error:  # the first one says enough
                raise make_writing_error(error, Path(destination)) from error

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


def _report_estimate(scene: Scene, estimate: TimeEstimate, compiling: bool) -> None:
    gib = estimate_memory(scene.width, scene.height, len(scene.train_frames))
    report(
        f"{scene.num_frames} frames of {scene.width} x {scene.height}, {len(scene.heldout_frames)} of them held out: "
        f"{estimate} and {gib:.1f} GiB for a whole run{', which compiles the kernels this once' if compiling else ''}."
    )
