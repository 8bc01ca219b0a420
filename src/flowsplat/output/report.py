"""``report.html``: one page about a run that needs no network and no other file (its videos lie beside it)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from flowsplat.common.durations import format_duration
from flowsplat.common.run_paths import RunPaths
from flowsplat.evaluation.baselines import title_of
from flowsplat.evaluation.scores import pick
from flowsplat.images.charts import Points, line_chart
from flowsplat.images.colors import error_to_color, flow_legend, flow_scale, flow_to_color
from flowsplat.images.html import data_uri, figure, image_tag, shrink_to_page, table
from flowsplat.output.page import card, image_row, write_page
from flowsplat.output.verdict import list_large_objects, verdict, word_figures, word_sureness
from flowsplat.output.videos.paths import PATHS
from flowsplat.output.videos.shown import order_videos

POSTER_QUALITY = 80
"""Of the JPEGs that stand in the place of videos until they play. Chosen by eye."""

_STAGES = {
    "coarse": "coarse scene", "train": "training", "static": "static scene", "evaluate": "measuring", "render": "videos",
}  # fmt: skip


class Comparison(NamedTuple):
    """A frame of the clip and its rendering, [H, W, 3] uint8 or float between 0 and 1."""

    label: str
    input: np.ndarray
    rendering: np.ndarray


class FlowComparison(NamedTuple):
    """Rendered flow and the prior that taught it, [H, W, 2] pixels; NaN where there is none."""

    label: str
    rendered: np.ndarray
    prior: np.ndarray


class Step(NamedTuple):
    """What a user can do now, in words, and the command for it."""

    words: str
    command: str


@dataclass(frozen=True)
class ReportData:
    """What the report tells.

    Attributes:
        title: name of the scene.
        metrics: the content of ``metrics.json``; missing keys are like null ones.
        history: entries of the training history: ``step``, ``loss``, ``psnr`` and so on.
        comparisons: the first one is shown on top.
        flows: rendered flow against the prior.
        active: (seconds, number of Gaussians active then, in the image or not).
        config: the settings by dotted name.
        notes: sentences for the user, such as what was done to the input.
        videos: file names in ``renders/`` by name, as ``output.videos.list_rendered`` tells them.
        posters: the first image of each, by the same names, as far as they can be read.
        steps: what to do now.
    """

    title: str
    metrics: Mapping[str, Any]
    history: Sequence[Mapping[str, float]] = ()
    comparisons: Sequence[Comparison] = ()
    flows: Sequence[FlowComparison] = ()
    active: tuple[Sequence[float], Sequence[float]] = ((), ())
    config: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()
    videos: Mapping[str, str] = field(default_factory=dict)
    posters: Mapping[str, np.ndarray] = field(default_factory=dict)
    steps: Sequence[Step] = ()


def write_report(folder: Path, data: ReportData) -> Path:
    """Write ``report.html`` into the folder of a run and return its path.

    Raises:
        InputError: the folder cannot be written.
    """
    path = RunPaths(folder).report_path
    write_page(
        path,
        "report.html.jinja",
        title=data.title,
        verdict=verdict(data.metrics),
        figures=word_figures(data.metrics),
        headline=_headline(data.metrics),
        videos=list(_videos(data.videos, data.posters)),
        steps=data.steps,
        comparisons=[_comparison(*comparison) for comparison in data.comparisons],
        flows=_flows(data.flows),
        legend=image_tag(flow_legend(), "The color of every direction of flow", None),
        tables=list(_tables(data.metrics)),
        charts=list(_charts(data)),
        notes=data.notes,
        settings=_settings(data.config) if data.config else None,
    )
    return path


# -- figures


def _headline(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the few figures on top: value, unit, name and a remark."""
    kind, name = "heldout_frames", "held-out frames"
    if pick(metrics, kind, "psnr") is None:
        kind, name = "training_frames", "training frames"
    theirs = pick(metrics, "baselines", "flow_interpolation", "psnr") if kind == "heldout_frames" else None
    against = name if theirs is None else f"{name}; interpolation: {theirs:.2f} dB"
    seconds = metrics.get("wall_seconds")
    flow, flow_name = pick(metrics, "flow_epe", "mean"), "flow error"
    if flow is None:
        flow, flow_name = pick(metrics, "flow_prior_epe", "mean"), "flow against its prior"
    active = pick(metrics, "gaussians", "active_mean")
    return [
        card(figure(pick(metrics, kind, "psnr")), "dB", "PSNR along the clip's path", against),
        _aside_card(metrics),
        card(figure(pick(metrics, kind, "ssim"), 3), "", "SSIM along the clip's path", f"{name}; 1 = equal"),
        card(figure(flow, 2), "px", flow_name, "mean end-point error"),
        card(
            figure(pick(metrics, "gaussians", "total"), 0),
            "",
            "Gaussians",
            "" if active is None else f"{active:,.0f} active at a time",
        ),
        card(Markup(format_duration(seconds)) if seconds else figure(None), "", "for everything", _memory(metrics)),
    ]


def _aside_card(metrics: Mapping[str, Any]) -> dict[str, Any]:
    views, error = pick(metrics, "heldout_views", "psnr"), pick(metrics, "depth_abs_rel", "moving", "mean")
    if views is not None:
        moving = pick(metrics, "heldout_views", "moving", "psnr")
        objects = "" if moving is None else f"; objects: {moving:.2f} dB"
        return card(figure(views), "dB", "PSNR from aside", f"held-out views{objects}")
    if error is not None:
        return card(figure(100 * error, 0), "%", "depth error of objects", "from aside: no view was measured")
    known = list_large_objects(metrics)
    sure = f"objects' distance: {word_sureness(known)}" if known else "neither views nor true depth are known"
    return card(figure(None, reason=sure), "", "from aside: not measured", sure)


def _memory(metrics: Mapping[str, Any]) -> str:
    peak = metrics.get("peak_memory_gib")
    return "" if peak is None else f"{peak:.1f} GiB of memory at most"


def _tables(metrics: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Titled tables of everything that was measured."""
    lpips = metrics.get("lpips_reason")
    if pick(metrics, "heldout_frames") is not None:
        remark = "Frames of the clip that training has not seen, and of the priors only the cameras; objects are the given masks."
        if pick(metrics, "heldout_frames_refined") is not None:
            remark += (
                " Poses of held-out frames are used as they were estimated; refined is what comes out when the pose of each alone "
                "is fitted to its own image, and tells how much is the cameras' fault."
            )
        rows = _scores(metrics, "heldout_frames", "baselines", ("moving",), lpips)
        yield {"title": "Held-out frames", "remark": remark, "table": rows}
    if pick(metrics, "heldout_views") is not None:
        remark = "Images by other cameras; covisible are the pixels that the clip itself saw."
        rows = _scores(metrics, "heldout_views", "baselines_views", ("moving", "covisible"), lpips)
        yield {"title": "Held-out views", "remark": remark, "table": rows}
    if pick(metrics, "training_frames") is not None:
        rows = _scores(metrics, "training_frames", "", ("moving",), lpips)
        yield {"title": "Training frames", "remark": "How well what was seen is reproduced.", "table": rows}
    errors = list(_errors(metrics))
    if errors:
        header = ("", "mean", "median", "objects, mean", "objects, median")
        yield {"title": "Flow and depth", "remark": "", "table": table(header, errors)}
    objects = pick(metrics, "gaussians", "objects")
    if objects:
        remark = "Of the number that an object has in the masks; --render.parts objects:NUMBER shows it alone."
        rows = table(("object", "Gaussians"), [(number, f"{count:,}") for number, count in objects.items()])
        yield {"title": "Objects", "remark": remark, "table": rows}
    seconds = metrics.get("seconds") or {}
    if seconds:
        spent = [(_STAGES.get(stage, stage), format_duration(value)) for stage, value in seconds.items()]
        whole = metrics.get("wall_seconds") or 0.0
        spent.append(
            ("compiling kernels, starting, and between the stages", format_duration(max(whole - sum(seconds.values()), 0.0)))
        )
        spent.append(("from start to end", format_duration(whole)))
        yield {"title": "Time", "remark": "", "table": table(("stage", "time"), spent, [len(spent) - 1])}


def _scores(metrics: Mapping[str, Any], ours: str, others: str, regions: Sequence[str], lpips_reason: str | None) -> Markup:
    """PSNR, SSIM and LPIPS of this scene and of the methods that it is compared with."""
    names = {"moving": "objects", "covisible": "covisible"}
    refined = metrics.get(f"{ours}_refined")
    header = ["", "PSNR dB", "SSIM", "LPIPS", *(f"PSNR, {names[region]}" for region in regions)]
    header += ["PSNR, pose refined", "SSIM, pose refined"] if refined else []
    measured = [(name, value) for name, value in (pick(metrics, others) or {}).items() if value is not None]
    rows = []
    for name, values in [("this scene", metrics[ours]), *((title_of(name), value) for name, value in measured)]:
        row = [
            name,
            figure(pick(values, "psnr")),
            figure(pick(values, "ssim"), 3),
            figure(pick(values, "lpips"), 3, lpips_reason),
        ]
        for region in regions:
            row.append(figure(pick(values, region, "psnr"), 2, "no masks to tell which pixels these are"))
        if refined:
            known = refined if values is metrics[ours] else {}
            row += [figure(pick(known, key), digits, "no pose to refine") for key, digits in (("psnr", 2), ("ssim", 3))]
        rows.append(row)
    return table(header, rows, [0])


def _errors(metrics: Mapping[str, Any]) -> Iterator[Sequence[str]]:
    """Yield rows of flow errors in pixels and of relative depth errors."""
    reason = "no masks to tell which pixels move"
    for key, name in (
        ("flow_epe", "flow against the truth, px"),
        ("prior_flow_epe", "flow of the prior against the truth, px"),
        ("flow_prior_epe", "flow against the prior, px"),
    ):
        values = pick(metrics, key)
        if values is not None:
            moving = [figure(pick(values, "moving", kind), 2, reason) for kind in ("mean", "median")]
            yield name, figure(pick(values, "mean")), figure(pick(values, "median")), *moving
    depth = pick(metrics, "depth_abs_rel")
    if depth is not None:
        cells = [figure(pick(depth, area, kind), 3, reason) for area in ("all", "moving") for kind in ("mean", "median")]
        yield "depth, relative error", *cells


def _settings(config: Mapping[str, Any]) -> Markup:
    return table(("setting", "value"), [(name, "none" if value is None else str(value)) for name, value in config.items()])


# -- images


def _comparison(label: str, image: np.ndarray, rendering: np.ndarray) -> dict[str, Any]:
    panels = {"clip": image, "rendering": rendering, "error": error_to_color(image, rendering)}
    return {"label": label, "panels": image_row(panels, label)}


def _flows(flows: Sequence[FlowComparison]) -> list[dict[str, Any]]:
    """Return every pair in one color scale."""
    shown = []
    for label, rendered, prior in flows:
        scale = flow_scale([rendered, prior])
        panels = {name: flow_to_color(flow, scale) for name, flow in (("rendered", rendered), ("prior", prior))}
        shown.append({"label": f"{label}; full color = {scale:.1f} px", "panels": image_row(panels, label)})
    return shown


def _videos(videos: Mapping[str, str], posters: Mapping[str, np.ndarray]) -> Iterator[dict[str, Any]]:
    """Yield every video, that along the clip's own path first: in color where there is that, with a link to the one that has flow
    and depth beside it."""
    for name, shown, beside in order_videos(videos):
        poster = posters.get(shown)
        yield {
            "title": video_title(name),
            "file": link_video(videos[shown]),
            "image": videos[shown].endswith(".gif"),
            "poster": None if poster is None else data_uri(shrink_to_page(poster), POSTER_QUALITY),
            "panels": None if beside is None else link_video(videos[beside]),
        }


def link_video(file: str) -> str:
    """Return the address of a video of a run, from the folder of the run."""
    return f"{RunPaths(Path()).renders_path.name}/{quote(file)}"


def video_title(name: str) -> str:
    """Return what a video shows, from its name: path, tempo, part of the scene, stereo."""
    rest = name
    words: list[str] = []
    for suffix, word in (("_stereo", "for two eyes"), ("_background", "the background alone")):
        if rest.endswith(suffix):
            rest = rest.removesuffix(suffix)
            words.insert(0, word)
    if objects := re.search(r"_objects((?:_\d+)*)$", rest):
        rest, numbers = rest[: objects.start()], objects[1].strip("_").replace("_", ", ")
        words.insert(0, f"object {numbers} alone" if numbers else "the objects alone")
    if moved := re.search(r"_distance((?:_\d+x[^_x]+)+)$", rest):
        rest, distances = rest[: moved.start()], moved[1].strip("_").split("_")
        words.insert(0, ", ".join("object {} {} times as far".format(*entry.split("x")) for entry in distances))
    if rest.endswith("_confidence_fade"):
        rest = rest.removesuffix("_confidence_fade")
        words.insert(0, "without guesses")
    if slow := re.search(r"_slow(\d[^_]*)$", rest):
        rest = rest[: slow.start()]
        words.insert(0, f"{slow[1]} times slower")
    if rest.startswith("custom_path_"):
        rest = f"Along the camera path {rest.removeprefix('custom_path_')}"
    titles = {entry.value.file: entry.sentence.rstrip(".") for entry in PATHS.entries()}
    return ", ".join([titles.get(rest, rest), *words])


def _charts(data: ReportData) -> Iterator[dict[str, Any]]:
    """Titled line charts of the training and of the Gaussians over time."""

    def over_steps(names: Mapping[str, str]) -> dict[str, Points]:
        """Series by label, of those keys that the history has with a value other than 0."""
        kept = {label: key for key, label in names.items() if any(entry.get(key) for entry in data.history)}
        steps = [entry["step"] for entry in data.history]
        return {label: (steps, [entry.get(key) for entry in data.history]) for label, key in kept.items()}

    plans: list[tuple[str, dict[str, Points], str, bool]] = [
        ("PSNR of the training frames", over_steps({"psnr": "PSNR"}), "dB", False),
        ("Loss", over_steps({"loss": "loss"}), "loss", True),
        (
            "Parts of the loss",
            over_steps({key: key for key in ("color", "flow", "rigid", "depth", "coverage")}),
            "loss",
            True,
        ),
        ("Gaussians in training", over_steps({"gaussians": "all", "active": "rendered"}), "Gaussians", False),
    ]
    for title, series, y_label, log in plans:
        if series:
            yield {
                "title": title,
                "chart": line_chart(series, title=title, x_label="step", y_label=y_label, log=log),
            }
    if len(data.active[0]):
        title = "Gaussians active over the clip"
        series = {"active": data.active}
        chart = line_chart(series, title=title, x_label="seconds of the clip", y_label="Gaussians")
        yield {"title": title, "chart": chart}
