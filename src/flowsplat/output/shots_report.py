"""``report.html`` of a clip with cuts: its shots, each with its figures, a video, and a link to its own report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from flowsplat.common.durations import format_duration
from flowsplat.common.run_paths import RunPaths
from flowsplat.evaluation.scores import pick
from flowsplat.images.html import data_uri, figure, shrink_to_page, table
from flowsplat.output.page import write_page
from flowsplat.output.report import POSTER_QUALITY, link_video, video_title
from flowsplat.output.verdict import verdict
from flowsplat.output.videos.shown import choose_video


@dataclass(frozen=True)
class ShotOnPage:
    """What the page shows of a shot.

    Attributes:
        folder: of its run, relative to the page.
        title: its number and seconds.
        metrics: the content of its ``metrics.json``; None where it was not measured yet.
        videos: file names in its ``renders/`` by name.
        poster: the first image of the video that is shown, where it can be read.
    """

    folder: str
    title: str
    metrics: Mapping[str, Any] | None
    videos: Mapping[str, str]
    poster: np.ndarray | None = None


def write_shots_report(path: Path, title: str, shots: Sequence[ShotOnPage], notes: Sequence[str]) -> None:
    """Write the page.

    Args:
        title: name of the clip.
        notes: what was left out, and why.

    Raises:
        InputError: it cannot be written.
    """
    done = sum(shot.metrics is not None for shot in shots)
    unfinished = "" if done == len(shots) else f"; {done} of them {'is' if done == 1 else 'are'} done"
    header = ("shot", "PSNR dB", "SSIM", "interpolation, PSNR dB", "Gaussians", "time")
    write_page(
        path,
        "shots.html.jinja",
        title=title,
        verdict=f"{len(shots)} shot{'s' * (len(shots) != 1)}, each a scene of its own{unfinished}.",
        table=table(header, [_row(shot) for shot in shots]),
        notes=notes,
        shots=[_section(shot) for shot in shots],
    )


def _row(shot: ShotOnPage) -> Sequence[Any]:
    metrics = shot.metrics or {}
    seconds = metrics.get("wall_seconds")
    return (
        shot.title,
        figure(pick(metrics, "heldout_frames", "psnr")),
        figure(pick(metrics, "heldout_frames", "ssim"), 3),
        figure(pick(metrics, "baselines", "flow_interpolation", "psnr")),
        figure(pick(metrics, "gaussians", "total"), 0),
        format_duration(seconds) if seconds else figure(None),
    )


def _section(shot: ShotOnPage) -> dict[str, Any]:
    video = choose_video(shot.videos)
    return {
        "title": shot.title,
        "verdict": None if shot.metrics is None else verdict(shot.metrics),
        "report": f"{quote(shot.folder)}/{RunPaths(Path()).report_path.name}",
        "video": None if video is None else f"{quote(shot.folder)}/{link_video(shot.videos[video.shown])}",
        "poster": None if shot.poster is None else data_uri(shrink_to_page(shot.poster), POSTER_QUALITY),
        "caption": "" if video is None else video_title(video.name),
    }
