"""Describe a run or a scene in lines for a person."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from flowsplat import __version__
from flowsplat.common.devices import backends
from flowsplat.common.durations import format_duration
from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json
from flowsplat.common.files.lease import holder
from flowsplat.common.run_paths import RunPaths
from flowsplat.images.html import NOTHING
from flowsplat.output.verdict import verdict
from flowsplat.pipeline.folder import MetricsFile, RunFolder
from flowsplat.pipeline.shot_list import ShotList, read_shots
from flowsplat.priors.graph import PRIORS
from flowsplat.scenes import Scene
from flowsplat.training.checkpoint import ModelFile

PACKAGES = ("torch", "numba", "numpy", "opencv-contrib-python-headless", "av", "torchmetrics")


def describe(path: Path | None) -> Iterator[str]:
    """Yield lines about a folder (where one is given), then versions and backends.

    Raises:
        InputError: the folder is neither a run nor a scene.
    """
    if path is not None:
        if RunPaths(path).record_path.exists():
            yield from _describe_run(RunFolder(path))
        elif (listed := read_shots(path)) is not None:
            yield from _describe_shots(path, listed)
        elif (path / "scene.json").exists():
            yield from _describe_scene(Scene(path))
        else:
            raise InputError(f"{path} is neither the folder of a run nor a prepared scene.")
        yield ""
    yield f"flowsplat {__version__}, Python {platform.python_version()}, {platform.platform()}"
    yield ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    for backend in backends():
        yield f"backend {backend.name}: {'works' if backend.works else 'does not work'} ({backend.reason})"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "is not installed"


def _figure(value: float | None, digits: int) -> str:
    return NOTHING if value is None else f"{value:.{digits}f}"


def _describe_shots(path: Path, listed: ShotList) -> Iterator[str]:
    yield f"Shots {path}: {len(listed.shots)}, each a run of its own"
    if (who := holder(path)) is not None:
        yield f"  is being written by {who}"
    for note in listed.notes:
        yield f"  {note}"
    for shot in listed.shots:
        yield f"Shot {shot}"
        if RunPaths(shot.path).record_path.exists():
            yield from _describe_run(RunFolder(shot.path))
        else:
            yield "  not begun yet"


def _describe_run(folder: RunFolder) -> Iterator[str]:
    yield f"Run {folder.path} of {folder.record['input']}"
    if (who := holder(folder.path)) is not None:
        yield f"  is being written by {who}"
    trained = folder.is_of_scene("train")
    for stage in ("coarse", "prepare", "train", "evaluate", "all_frames", "render"):
        entry = folder.record["stages"].get(stage)
        if (stage == "all_frames" and not folder.config.final_fit) or (stage == "coarse" and entry is None):
            continue
        counts = trained or stage in ("coarse", "prepare")
        state = "not finished" if entry is None or not counts else f"finished in {format_duration(sum(entry['seconds'].values()))}"
        yield f"  {stage}: {state}"
    metrics = folder.metrics_path
    if trained and metrics.exists():
        values = read_json(metrics, MetricsFile)
        yield f"  {verdict(values)}"
        for name in ("heldout_frames", "heldout_views", "training_frames"):
            if values.get(name):
                psnr, ssim = _figure(values[name]["psnr"], 2), _figure(values[name]["ssim"], 3)
                yield f"  {name.replace('_', ' ')}: PSNR {psnr}, SSIM {ssim}"
    model = folder.model_path / "model.json"
    if model.exists():
        value = read_json(model, ModelFile)
        yield f"  model: {value['gaussians']:,} Gaussians, {value['dynamic']:,} of them move"
        if value.get("objects"):
            yield "  Gaussians of the objects: " + ", ".join(f"{count:,} of {number}" for number, count in value["objects"].items())
        if "train" in folder.record["stages"] and not trained:
            yield f"  model: it is of the scene before it was prepared anew; flowsplat train {folder.path} trains it again"
    elif trained:
        yield f"  model: {folder.model_path} is gone; flowsplat train {folder.path} trains it again"
    if (folder.scene_path / "scene.json").exists():
        yield from _describe_scene(Scene(folder.scene_path))


def _describe_scene(scene: Scene) -> Iterator[str]:
    seconds = scene.timestamps[-1] - scene.timestamps[0]
    yield f"Scene {scene.folder}: {scene.name}, from {scene.info.source}"
    yield (
        f"  {scene.num_frames} frames of {scene.width} x {scene.height} over {seconds:.2f} s, "
        f"{len(scene.train_frames)} for training, {len(scene.heldout_frames)} held out"
    )
    for name in PRIORS.names:
        how = scene.prior(name)
        yield f"  {name}: " + ("missing" if how is None else str(how.get("verdict", how.get("method"))))
    if scene.truth is not None:
        yield f"  truth is there; {len(scene.views)} held-out views"
