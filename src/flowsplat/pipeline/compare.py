"""Runs beside each other on one page: ``flowsplat compare RUN RUN...`` and ``flowsplat.compare``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from flowsplat.common.durations import format_duration
from flowsplat.common.errors import InputError
from flowsplat.common.run_paths import RunPaths
from flowsplat.common.settings import flat, to_plain
from flowsplat.output.comparison_page import ComparedFigure, ComparedRun, write_comparison
from flowsplat.output.verdict import verdict
from flowsplat.output.videos import list_frame_rates, list_rendered
from flowsplat.pipeline.config import format_option
from flowsplat.pipeline.folder import RunFolder
from flowsplat.pipeline.python_run import Run
from flowsplat.pipeline.shot_list import resolve_run
from flowsplat.pipeline.summary import comparisons, list_rows, pick_all
from flowsplat.scenes import Scene

NAME = "compare.html"
MAX_RUNS = 12
"""Runs on one page: each video of each is in it. Chosen by eye."""


def compare(*runs: str | Path | Run, out: str | Path | None = None) -> Path:
    """Write one page that shows measured runs beside each other: videos in step, figures, and the settings that differ.

    The page is one file that needs neither a network nor the folders of the runs.

    Args:
        runs: two runs or more, or their folders, in the order in which they are shown.
        out: the page; None = ``compare.html`` beside the folder of the first run.

    Returns:
        the page.

    Raises:
        InputError: fewer than two runs, a folder that holds none, one that was not measured yet or is named twice, or a page that
            cannot be written.

    Examples:
        >>> flowsplat.compare("out/clip", "out/clip")
        Traceback (most recent call last):
        flowsplat.common.errors.InputError: out/clip is named twice: compare different runs.
    """
    folders = [run.folder if isinstance(run, Run) else resolve_run(Path(run)) for run in runs]
    if not 2 <= len(folders) <= MAX_RUNS:
        raise InputError(f"{len(folders)} run(s) to compare: name 2 to {MAX_RUNS} folders of runs.")
    resolved = [folder.resolve() for folder in folders]
    for k, folder in enumerate(resolved):
        if folder in resolved[:k]:
            raise InputError(f"{folders[k]} is named twice: compare different runs.")
    compared = [_read(folder, label) for folder, label in zip(folders, name_folders(resolved), strict=True)]
    scenes = [Scene(RunPaths(folder).scene_path) for folder in folders]
    is_same_clip = all(_has_same_frames(scenes[0], scene) for scene in scenes[1:])
    path = resolved[0].parent / NAME if out is None else Path(out)
    if path.is_dir():
        raise InputError(f"{path} is a folder: name the page with -o.")
    write_comparison(
        path, compared, figures=_figures([run.metrics for run in compared]), is_same_clip=is_same_clip,
        images=[list(comparisons(folder, scene)) for folder, scene in zip(folders, scenes, strict=True)] if is_same_clip else [],
    )  # fmt: skip
    return path


def name_folders(folders: Sequence[Path]) -> list[str]:
    """As few of the last parts of each path as tell them apart, the same number of all.

    Examples:
        >>> name_folders([Path("/a/own"), Path("/a/true")])
        ['own', 'true']
        >>> name_folders([Path("/x/1/run"), Path("/x/2/run")])
        ['1/run', '2/run']
    """
    longest = max(len(folder.parts) for folder in folders)
    for count in range(1, longest + 1):
        names = ["/".join(folder.parts[-count:]) for folder in folders]
        if len(set(names)) == len(names):
            return names
    return [str(folder) for folder in folders]


def _read(path: Path, label: str) -> ComparedRun:
    folder = RunFolder(path)
    metrics = Run(path).metrics
    settings = {format_option(name): value for name, value in flat(to_plain(folder.config)).items()}
    # Without the folders of this machine: a page is made to be shown.
    settings = {"input": PurePath(folder.record["input"]).name, **settings}
    videos = folder.renders_path
    return ComparedRun(label, verdict(metrics), metrics, settings, videos, list_rendered(videos), list_frame_rates(videos))


def _has_same_frames(one: Scene, other: Scene) -> bool:
    """Return whether figures of both are of the same images, as far as their scenes tell."""
    return (
        (one.width, one.height, one.heldout_frames) == (other.width, other.height, other.heldout_frames)
        and len(one.timestamps) == len(other.timestamps)
        and bool(np.allclose(one.timestamps - one.timestamps[0], other.timestamps - other.timestamps[0], atol=1e-3))
    )


def _figures(metrics: Sequence[Mapping[str, Any]]) -> list[ComparedFigure]:
    """Return the rows of the terminal's table, and the time."""
    found = []
    for label, path, style in list_rows():
        values = [None if value is None else format(value, style) for value in pick_all(metrics, path)]
        if any(value is not None for value in values):
            found.append(ComparedFigure(label, values, _find_best(path, values)))
    times = [format_duration(each.get("wall_seconds", 0.0)) for each in metrics]
    return [*found, ComparedFigure("time", times, ())]


def _find_best(path: Sequence[str], values: Sequence[str | None]) -> tuple[int, ...]:
    """Return which values of a figure are the best, as they are shown; none where all are the same, or more is neither better nor
    worse."""
    known = {k: float(value.replace(",", "")) for k, value in enumerate(values) if value is not None}
    if len(set(known.values())) < 2 or path[0].startswith("baselines"):
        return ()
    if path[-1] in ("psnr", "ssim"):
        best = max(known.values())
    elif path[0] in ("flow_epe", "flow_prior_epe", "depth_abs_rel"):
        best = min(known.values())
    else:
        return ()
    return tuple(k for k, value in known.items() if value == best)
