"""Figures of runs as a table for the terminal, and the material of the report."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from flowsplat.common.durations import format_duration
from flowsplat.common.errors import InputError
from flowsplat.common.run_paths import RunPaths
from flowsplat.common.settings import flat, to_plain
from flowsplat.evaluation.baselines import list_baselines, title_of
from flowsplat.evaluation.scores import pick
from flowsplat.gaussians.renderer import Renderer
from flowsplat.output.report import Comparison, FlowComparison, ReportData, Step
from flowsplat.output.verdict import grade_sharpness, list_guesses
from flowsplat.output.videos import list_rendered, read_posters
from flowsplat.output.videos.shown import order_videos
from flowsplat.pipeline.config import RunConfig, list_options, preset
from flowsplat.pipeline.left_out import word_left_out_after
from flowsplat.priors.objects.description import word_guess, word_hint
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import read_image

SHOWN_IMAGES = 6
"""Held-out images of each kind in the report. Chosen by eye."""

SHOWN_NOTE = (
    "Videos, exports and the viewer show the scene after it was fitted to the held-out frames, too (model_all_frames/). Every "
    "figure and every comparison here is of the model before that (model/), which has not seen them."
)

Row = tuple[str, tuple[str, ...], str]
"""What a figure is called, the keys that lead to it, and how it is written."""

_OURS: tuple[Row, ...] = (
    ("held-out frames, PSNR", ("heldout_frames", "psnr"), ".2f"),
    ("held-out frames, SSIM", ("heldout_frames", "ssim"), ".3f"),
    ("held-out frames, PSNR inside the masks", ("heldout_frames", "moving", "psnr"), ".2f"),
    ("the same with their poses refined, PSNR", ("heldout_frames_refined", "psnr"), ".2f"),
    ("held-out views, PSNR", ("heldout_views", "psnr"), ".2f"),
    ("held-out views, SSIM", ("heldout_views", "ssim"), ".3f"),
    ("held-out views, PSNR of objects", ("heldout_views", "moving", "psnr"), ".2f"),
    ("training frames, PSNR", ("training_frames", "psnr"), ".2f"),
)
_REST: tuple[Row, ...] = (
    ("static scene, PSNR inside the masks", ("baselines", "static", "moving", "psnr"), ".2f"),
    ("views by warping with true depth, PSNR", ("baselines_views", "warp_by_depth", "psnr"), ".2f"),
    ("views by warping, PSNR of objects", ("baselines_views", "warp_by_depth", "moving", "psnr"), ".2f"),
    ("flow end-point error, median px", ("flow_epe", "median"), ".3f"),
    ("flow end-point error, mean px", ("flow_epe", "mean"), ".3f"),
    ("flow against the prior, median px", ("flow_prior_epe", "median"), ".3f"),
    ("depth, relative error", ("depth_abs_rel", "all", "mean"), ".3f"),
    ("Gaussians", ("gaussians", "total"), ",.0f"),
    ("Gaussians active at a time", ("gaussians", "active_mean"), ",.0f"),
    ("peak memory, GiB", ("peak_memory_gib",), ".1f"),
)


def list_rows() -> tuple[Row, ...]:
    """Return the figures that a run shows at its end, those of every baseline among them."""
    baselines = ((f"{title_of(name)}, PSNR", ("baselines", name, "psnr"), ".2f") for name in list_baselines(of_views=False))
    return (*_OURS, *baselines, *_REST)


def figures_table(runs: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return one column a run; rows that no run has are left out."""
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for name in runs:
        table.add_column(name, justify="right")
    for label, path, style in list_rows():
        values = pick_all(list(runs.values()), path)
        if any(value is not None for value in values):
            table.add_row(label, *("–" if value is None else format(value, style) for value in values))
    table.add_row("time", *(format_duration(metrics.get("wall_seconds", 0.0)) for metrics in runs.values()))
    return table


def pick_all(metrics: Sequence[Mapping[str, Any]], path: Sequence[str]) -> list[float | None]:
    """Return the figure under ``path`` in the figures of every run; None where it was not measured."""
    return [pick(each, *path) for each in metrics]


def next_steps(out: Path) -> Iterator[str]:
    """Yield what to do with a run that is finished."""
    yield f"  its report:      {RunPaths(out).report_path}"
    yield f"  look around:     {_view(out)}"
    yield f"  a page to share: {_share(out)}"


def _view(out: Path) -> str:
    return _command("view", out)


def _share(out: Path) -> str:
    return _command("export", out, "--to", "html")


def _command(*words: object) -> str:
    return shlex.join(["flowsplat", *map(str, words)])


def list_steps(out: Path, source: str, metrics: Mapping[str, Any], config: RunConfig) -> Iterator[Step]:
    """Yield what to do with a run that was measured, each with its command: first what makes it better.

    Args:
        out: folder of the run.
        source: its input.
        metrics: as in metrics.json.
        config: its settings.
    """
    for obj in list_guesses(metrics):
        if obj.get("hint") and "number" in obj:
            contact = replace(config.priors, contact=(*config.priors.contact, obj["hint"]))
            words = f"{word_guess(obj['number'], obj['hint'])}, this makes it sure (name another place where that is wrong):"
            yield Step(words, _command("run", source, "-o", out, *list_options(replace(config, priors=contact))))
    yield Step("Look around in it, in your browser:", _view(out))
    yield Step("Send it: one page that plays it on any phone or computer:", _share(out))
    if pick(metrics, "gaussians", "objects"):
        words = "See it without what moves, along your own path:"
        yield Step(words, _command("render", out, "--render.paths", "input", "--render.parts", "background"))
    if grade_sharpness(metrics.get("heldout_frames")) not in (None, "sharp") and config.train != preset("high").train:
        words = (
            "Make it sharper, in about ten times the training time of the default (docs/tutorial.md, “If it looks bad”, has more):"
        )
        yield Step(words, f"{_command('train', out, '--preset', 'high')} && {_command('render', out)}")


def suggest_hints(metrics: Mapping[str, Any]) -> list[str]:
    """Tell of every large object whose distance is a guess how one click makes it sure."""
    objects = [obj for obj in metrics.get("objects") or [] if not obj.get("small") and obj.get("hint") and "number" in obj]
    return [word_hint(obj["number"], obj["hint"]) for obj in objects]


def report_data(
    out: Path, source: str, scene: Scene, flows: Sequence[FlowComparison], metrics: Mapping[str, Any],
    history: Sequence[Mapping[str, float]], config: RunConfig,
) -> ReportData:  # fmt: skip
    """Return what the report of the run of ``source`` in ``out`` tells, with ``flow_comparisons``.

    Raises:
        InputError: the figures are those of other frames.
    """
    counts = metrics["gaussians"]["active"]
    if len(counts) != len(scene.timestamps):
        raise InputError(f"{out / 'metrics.json'} counts Gaussians in {len(counts)} frames, the scene has {len(scene.timestamps)}.")
    notes = [*scene.info.notes, *([SHOWN_NOTE] if metrics.get("shown") != metrics.get("measured") else [])]
    left_out = word_left_out_after(scene, config, metrics)
    notes += [left_out] if left_out else []
    videos = list_rendered(RunPaths(out).renders_path)
    shown = {video.shown: videos[video.shown] for video in order_videos(videos)}
    verdicts = {name: str((scene.prior(name) or {}).get("verdict", "")) for name in ("cameras", "depth", "masks")}
    return ReportData(
        title=scene.name,
        metrics=metrics,
        history=history,
        comparisons=list(comparisons(out, scene)),
        flows=flows,
        active=(scene.timestamps.tolist(), counts),
        config=flat(to_plain(config)),
        notes=[*notes, *(f"{name.capitalize()}: {words}" for name, words in verdicts.items() if words)],
        videos=videos,
        posters=read_posters(RunPaths(out).renders_path, shown),
        steps=list(list_steps(out, source, metrics, config)),
    )


def _spread(items: Sequence[Any], count: int) -> list[Any]:
    """At most ``count`` of them, evenly spread, the middle one first."""
    chosen = [items[round((k + 0.5) * len(items) / count - 0.5)] for k in range(count)] if len(items) > count else list(items)
    middle = len(chosen) // 2
    return chosen[middle : middle + 1] + chosen[:middle] + chosen[middle + 1 :]


def comparisons(out: Path, scene: Scene) -> Iterator[Comparison]:
    """Held-out images beside their renderings, as the evaluation wrote them."""
    for i in _spread(scene.heldout_frames, SHOWN_IMAGES):
        rendering = RunPaths(out).evaluation_path / "heldout" / f"{i:05d}.png"
        if rendering.exists():
            yield Comparison(f"Held-out frame {i}", scene.heldout_frame(i), read_image(rendering))
    for view in _spread(scene.views, SHOWN_IMAGES):
        rendering = RunPaths(out).evaluation_path / "views" / f"{view.name}.png"
        if rendering.exists():
            yield Comparison(f"Held-out view {view.name}", scene.view_image(view), read_image(rendering))


def flow_comparisons(scene: Scene, model: Renderer) -> Iterator[FlowComparison]:
    """Yield rendered flow beside the prior, NaN where it is not trusted."""
    known, times = set(scene.flow_pairs), scene.timestamps
    pairs = [pair for pair in pairwise(scene.train_frames) if pair in known]
    for i, j in _spread(pairs, 3):
        prior = scene.flow(i, j)
        rendered = model.render(scene.cameras[i], float(times[i]), (scene.cameras[j], float(times[j])))
        assert rendered.flow is not None
        shown = np.where(prior.trusted[..., None], prior.flow, np.nan)
        yield FlowComparison(f"Frame {i} to {j}", np.where(rendered.alpha[..., None] > 0.5, rendered.flow, np.nan), shown)
