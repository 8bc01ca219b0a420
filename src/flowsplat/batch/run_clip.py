"""Run one clip of a batch in its own process, and describe what the page of the batch shows of it."""

from __future__ import annotations

import os
import platform
import shutil
import statistics
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from flowsplat.batch.clips import BatchClip
from flowsplat.batch.records import FOLDER
from flowsplat.batch.upload import upload
from flowsplat.batch.work import Attempt, Job
from flowsplat.common.errors import InputError, InUseError
from flowsplat.common.files import as_written, atomic_path, lease, read_json
from flowsplat.common.progress import report
from flowsplat.common.run_paths import RunPaths
from flowsplat.common.source import source_state
from flowsplat.evaluation.scores import pick
from flowsplat.images.html import shrink_to_page
from flowsplat.output.verdict import grade_path, verdict
from flowsplat.output.videos import list_rendered
from flowsplat.output.videos.shown import choose_video
from flowsplat.pipeline import run
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.folder import RunFolder, stage_key
from flowsplat.pipeline.preparing import identify
from flowsplat.pipeline.shot_list import ShotsFile
from flowsplat.pipeline.shots import run_shots
from flowsplat.pipeline.speed import estimate_memory
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.ingest import kind_of_input, open_clip
from flowsplat.scenes.layers import read_image

THUMB_WIDTH = 240
"""Pixels of an image in the page of a batch. Chosen by eye."""
SPARSER_SPACING_FACTOR = 1.5
"""Times as far apart Gaussians begin in a run that outgrew its memory; at most half as many are allowed in the end.
Chosen by eye."""

FIGURES = {
    "psnr": ("heldout_frames", "psnr"), "ssim": ("heldout_frames", "ssim"), "views_psnr": ("heldout_views", "psnr"),
    "interpolation_psnr": ("baselines", "flow_interpolation", "psnr"), "gaussians": ("gaussians", "total"),
}  # fmt: skip
"""Of ``metrics.json``, which a record repeats."""
WORST_FIRST = ("worse", "unmeasured", "even", "better")
"""Grades of a path."""


def clip_job(clip: BatchClip, out: Path, copies: str | None = None) -> Job:
    """Return the run of a clip in ``OUT/<id>``. It is done again when its settings change, or the file that it is of.

    Args:
        copies: a URL that its folder is copied to when it is done.
    """
    try:
        found = os.stat(clip.path)
        stamp = [found.st_size, found.st_mtime_ns]
    except OSError:  # the run says what is wrong
        stamp = []
    return Job(clip.id, stage_key(str(clip.path), stamp, clip.config, copies), partial(run_clip, clip, Path(out), copies))


def run_clip(clip: BatchClip, out: Path, copies: str | None, attempt: Attempt) -> Mapping[str, Any]:
    """Run a clip, or what is missing of that; of a clip with cuts each shot, as ``flowsplat run`` does.

    Returns:
        ``input``, ``fingerprint`` (of its files, as ``run.json`` or ``shots.json`` has it), ``grade`` (better, even, worse,
        unmeasured), ``verdict`` in words, the figures of ``FIGURES``, ``stages`` (seconds of each), ``video`` (to look at, relative
        to OUT), ``thumb``, ``versions``, and ``uploaded`` (its copy, where there is one).

    Raises:
        InputError: as ``run``.
    """
    config = clip.config
    report(f"{clip.id}: {clip.path}")
    attempt.needs(_memory(clip.path, config.input))
    if attempt.fewer:
        report("It has outgrown its memory before: fewer Gaussians this time.")
        config = fewer_gaussians(config)
    folder = out / clip.id
    config = replace(config, coarse_scene=False)  # nobody looks meanwhile
    with _keep_while_changed(clip.path, folder, config):
        shots = run_shots(clip.path, folder, config)
        metrics = run(clip.path, folder, config) if shots is None else {}
    if shots is None:
        first, words, of_all, fingerprint = folder, verdict(metrics), [metrics], RunFolder(folder).fingerprint
    else:
        first, of_all = RunPaths(folder).shots_path / next(iter(shots)), list(shots.values())
        words = " ".join(f"Shot {name}: {verdict(metrics)}" for name, metrics in shots.items())
        fingerprint = read_json(RunPaths(folder).shots_record_path, ShotsFile)["fingerprint"]
    video = _video(first)
    return {
        "input": str(clip.path), "fingerprint": fingerprint, "verdict": words, **_describe(of_all),
        "video": None if video is None else video.relative_to(out).as_posix(), "thumb": _write_thumb(clip.id, first, out),
        "versions": {"flowsplat": source_state(), "python": platform.python_version(), "torch": torch.__version__},
        "uploaded": None if copies is None else upload(folder, copies),
    }  # fmt: skip


@contextmanager
def _keep_while_changed(path: Path, folder: Path, config: RunConfig) -> Iterator[None]:
    """Put what was made of a clip aside where other files are there now, or others of its frames are taken: it goes when the clip
    was done anew, and comes back where that turns out to be impossible.

    Raises:
        InputError: the clip cannot be used, or the folder is damaged; or as ``lease``.
    """
    run, aside = RunPaths(folder), folder.with_name(f".{folder.name}.before")
    if run.holds_run and not folder.resolve().is_relative_to(path.resolve()):  # what is written there would be a change
        before = RunFolder(folder).record if run.record_path.exists() else read_json(run.shots_record_path, ShotsFile)
        is_same_clip = before["input"] == as_written(str(path))  # that of another clip is refused
        if is_same_clip and before["fingerprint"] != identify(path, config):
            report(f"{path} is not what it was, or other frames of it are taken: its run begins anew.")
            with lease(folder):
                pass  # nobody else writes it
            shutil.rmtree(aside, ignore_errors=True)
            folder.rename(aside)
    try:
        yield
    except InputError as error:
        if aside.exists() and not isinstance(error, InUseError):
            shutil.rmtree(folder, ignore_errors=True)
            aside.rename(folder)
        raise
    shutil.rmtree(aside, ignore_errors=True)


def _describe(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what a record repeats of ``metrics.json``: of one run, or of the runs of all shots of a clip.

    Figures are means over the shots that have them, Gaussians and seconds are added, and the grade is that of the worst shot.
    """
    figures: dict[str, float | None] = {}
    for name, path in FIGURES.items():
        values = [value for metrics in runs if (value := pick(metrics, *path)) is not None]
        together = sum if name == "gaussians" else statistics.mean
        figures[name] = together(values) if values else None
    seconds: Counter[str] = Counter()
    for metrics in runs:
        seconds.update(metrics.get("seconds") or {})
    grades = {grade_path(metrics) for metrics in runs}
    return {"grade": next(grade for grade in WORST_FIRST if grade in grades), **figures, "stages": dict(seconds)}


def _memory(path: Path, options: InputOptions) -> float:
    """Return GiB that the run of an input needs.

    Raises:
        InputError: it cannot be used.
    """
    if kind_of_input(path) == "scene":
        scene = Scene(path)
        return estimate_memory(scene.width, scene.height, len(scene.train_frames))
    clip = open_clip(path, options)
    train, _ = clip.split(options)
    return estimate_memory(clip.width, clip.height, len(train))


def fewer_gaussians(config: RunConfig) -> RunConfig:
    """Return the settings of a run that may not take as much memory."""
    train = config.train
    init = replace(
        train.init, background_spacing=SPARSER_SPACING_FACTOR * train.init.background_spacing,
        foreground_spacing=SPARSER_SPACING_FACTOR * train.init.foreground_spacing,
    )  # fmt: skip
    density = replace(train.density, max_gaussians=max(1, train.density.max_gaussians // 2))
    gaussians = train.gaussians and max(1, train.gaussians // 2)
    return replace(config, train=replace(train, init=init, density=density, gaussians=gaussians))


def _video(folder: Path) -> Path | None:
    """Return what the page plays."""
    renders = RunPaths(folder).renders_path
    files = {name: file for name, file in list_rendered(renders).items() if (renders / file).exists()}
    video = choose_video(files)
    return None if video is None else renders / files[video.shown]


def _write_thumb(name: str, folder: Path, out: Path) -> str:
    """Return a small image of the result, of a held-out frame where there is one; its place, relative to OUT."""
    run = RunPaths(folder)
    scene = Scene(run.scene_path)
    shown = sorted((run.evaluation_path / "heldout").glob("[0-9][0-9][0-9][0-9][0-9].png"))
    image = read_image(shown[len(shown) // 2]) if shown else scene.frame(scene.train_frames[len(scene.train_frames) // 2])
    path = out / FOLDER / "thumbs" / f"{name}.jpg"
    with atomic_path(path) as temporary:
        data = cv2.imencode(
            ".jpg", np.ascontiguousarray(shrink_to_page(image, THUMB_WIDTH)[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 80]
        )[1]
        temporary.write_bytes(data.tobytes())
    return path.relative_to(out).as_posix()
