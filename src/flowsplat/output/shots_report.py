"""``report.html`` of a clip with cuts: its shots, each with its figures, a video, and a link to its own report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from flowsplat.common.durations import format_duration
from flowsplat.common.run_paths import RunPaths
from flowsplat.evaluation.scores import pick
from flowsplat.images.html import figure, table
from flowsplat.output.page import write_page
from flowsplat.output.report import verdict, video_title


@dataclass(frozen=True)
class ShotOnPage:
    """What the page shows of a shot.

    Attributes:
        folder: of its run, relative to the page.
        title: its number and seconds.
        metrics: the content of its ``metrics.json``; None where it was not measured yet.
        videos: file names in its ``renders/`` by name.
    """

    folder: str
    title: str
    metrics: Mapping[str, Any] | None
    videos: Mapping[str, str]


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
    videos = {name: file for name, file in shot.videos.items() if file.endswith(".mp4")}
    name = next((name for name in videos if not name.endswith("_color")), next(iter(videos), None))
    return {
        "title": shot.title,
        "verdict": None if shot.metrics is None else verdict(shot.metrics),
        "report": f"{quote(shot.folder)}/{RunPaths(Path()).report_path.name}",
        "video": None if name is None else f"{quote(shot.folder)}/{RunPaths(Path()).renders_path.name}/{quote(videos[name])}",
        "caption": "" if name is None else video_title(name),
    }
