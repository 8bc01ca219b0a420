"""Measure what more Gaussians and more frame-steps bring, and what they cost: PSNR against Gaussians, bytes of the page, seconds of
training and milliseconds an image, and against steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat.evaluation.scores import mean_of, pick
from flowsplat.images.charts import MAX_SERIES, Points, line_chart
from flowsplat.training.config import PRESETS
from flowsplat_benchmarks.ablations.page import how_measured, scene_names, write_ablation_report
from flowsplat_benchmarks.ablations.scenes import ablation_scenes, choose_scenes
from flowsplat_benchmarks.ablations.training_runs import comparable, list_training_runs
from flowsplat_benchmarks.ablations.variants import Variant
from flowsplat_benchmarks.resume import BenchmarkOptions, measure_jobs, results_in
from flowsplat_benchmarks.tables import Chart, Column, Result, Table, compute_scaled_mean

PROTOCOL = "caps"
SCENES = ("bear", "camel", "train", "workshop")
SEEDS = (0,)
"""Of the random numbers of the runs."""
FREE = 0
"""As a cap: as many Gaussians as ``default`` takes."""
FREE_CAP = PRESETS["default"].density.max_gaussians
"""What a result tells of such a run as its cap."""
CAPS = (100_000, 200_000, 400_000, FREE)
"""Gaussians at most, of the runs with different caps."""
STEPS = (400, 800, 1600, 3200)
"""Frame-steps of the runs with different numbers of steps."""
ITERATIONS = PRESETS["default"].iterations
"""Frame-steps of the runs with different caps."""
STEPS_CAP = 200_000
"""Gaussians of the runs with different numbers of steps."""
CLIP_SIDE = 854
"""Long side of the clips, pixels; a rendered scene keeps its own."""

REMARKS = (
    "A cap is that of --gaussians. The page is the file of export --to html, and an image one of the clip's own, by all threads.",
)
COLUMNS = (
    Column("PSNR", ("psnr",), 2), Column("PSNR of objects", ("moving",), 2), Column("SSIM", ("ssim",), 3),
    Column("PSNR of training frames", ("training_psnr",), 2), Column("Gaussians at the end", ("gaussians", "total"), 0),
    Column("active, mean", ("gaussians", "active_mean"), 0), Column("page, MB", ("page_bytes",), 2, 1e-6),
    Column("ms an image", ("image_seconds",), 1, 1e3), Column("seconds of training", ("seconds", "train"), 0),
    Column("of all cores", ("seconds", "train_cpu"), 0), Column("peak memory, GiB", ("peak_memory_gib",), 1),
)  # fmt: skip
COSTS = {
    "gaussians": ("Gaussians", ("gaussians", "total"), 1.0),
    "bytes": ("megabytes of the page", ("page_bytes",), 1e-6),
    "seconds": ("seconds of training", ("seconds", "train"), 1.0),
    "image": ("milliseconds an image", ("image_seconds",), 1e3),
}
"""What a cap saves, by the name of its chart: what to call it, its keys in a result, and a factor."""


def make_capped_variant(cap: int, steps: int) -> Variant:
    """At most so many Gaussians, and so many frame-steps with the schedules stretched to them."""
    changes = {"density.max_gaussians": FREE_CAP, "gaussians": cap, "iterations": steps}
    return Variant(f"cap{cap}", f"{_name(cap)}, {steps:,} steps", changes)


def _name(cap: int) -> str:
    return "free" if cap == FREE else f"{cap:,}"


def run_caps(
    root: Path,
    out: Path,
    scenes: Sequence[str] = SCENES,
    caps: Sequence[int] = CAPS,
    steps: Sequence[int] = STEPS,
    seeds: Sequence[int] = SEEDS,
    size: int = CLIP_SIDE,
    again: bool = False,
    options: BenchmarkOptions | None = None,
) -> Path:
    """Run or resume the runs with different caps and steps: one JSON a run, ``OUT/caps.md`` and ``.html``, and the images.

    Args:
        root: the data root.
        caps: numbers of Gaussians, each with ``ITERATIONS`` steps; ``FREE`` = as many as ``default`` takes.
        steps: numbers of frame-steps, each with ``STEPS_CAP`` Gaussians.
        size: long side of clips of DAVIS in pixels; 0 = as they are.
        again: forget the figures of these runs that are in OUT; prepared scenes stay.
        options: how many at a time, and by what.

    Returns:
        path of the page, which shows all runs in OUT with these settings and of this size.

    Raises:
        InputError: a number or a name cannot be used, or the folder cannot be written.
    """
    if any(not 0 <= value < FREE_CAP for value in caps) or any(value < 1 for value in steps):
        raise InputError(f"--caps are numbers of Gaussians below {FREE_CAP:,} (0 = free), --steps are 1 or more.")
    plan = dict.fromkeys([*((cap, ITERATIONS) for cap in caps), *((STEPS_CAP, count) for count in steps)])
    known = ablation_scenes(root, size)
    wanted = choose_scenes(root, known, scenes)
    jobs = [
        run.job(out)
        for run in list_training_runs(PROTOCOL, wanted, [make_capped_variant(*each) for each in plan], seeds, ITERATIONS, STEPS_CAP)
    ]

    def report(failed: Mapping[str, str]) -> Path:
        results = results_in(PROTOCOL, out)
        there = dict.fromkeys((_cap_of(result), result["iterations"]) for result in results)
        found, others = comparable(results, PROTOCOL, known, [make_capped_variant(*each) for each in there], ITERATIONS, STEPS_CAP)
        return write_report(out, found, failed, others)

    return measure_jobs(jobs, out, report, "runs", again, options)


def write_report(out: Path, results: Sequence[Result], failed: Mapping[str, str], others: int = 0) -> Path:
    """Write the tables and images of some results, and return the path of the page.

    Args:
        results: with the same settings and of the same size.
        failed: runs that could not be made, and why.
        others: how many results in ``out`` are none of these.

    Raises:
        InputError: the folder cannot be written.
    """
    tables = []
    capped = [result for result in results if result["iterations"] == ITERATIONS]
    if len({_cap_of(result) for result in capped}) > 1:
        charts = [
            _chart(f"PSNR against {what}", what, f"{PROTOCOL}_{name}", capped, _cap_of, path, factor)
            for name, (what, path, factor) in COSTS.items()
        ]
        note = f"Each with {ITERATIONS:,} frame-steps."
        tables.append(_table("PSNR against what it costs", note, "Gaussians at most", capped, _cap_of, charts))
    stepped = [result for result in results if _cap_of(result) == STEPS_CAP]
    if len({result["iterations"] for result in stepped}) > 1:
        charts = [_chart("PSNR against frame-steps", "frame-steps", f"{PROTOCOL}_steps", stepped, _steps_of, ("iterations",), 1.0)]
        note = f"Each with {STEPS_CAP:,} Gaussians at most."
        tables.append(_table("PSNR against frame-steps", note, "frame-steps", stepped, _steps_of, charts))
    verdict = f"Runs measured: {len(results)}."
    remarks = [*REMARKS, how_measured(results)] if results else []
    return write_ablation_report(out, PROTOCOL, "Gaussians and steps", verdict, remarks, tables, failed, others)


def _cap_of(result: Result) -> int:
    return FREE if result["cap"] == FREE_CAP else int(result["cap"])


def _steps_of(result: Result) -> int:
    return int(result["iterations"])


def _rank(value: int) -> float:
    """Free ones last."""
    return math.inf if value == FREE else value


def _groups(results: Sequence[Result], scene: str, axis: Callable[[Result], int]) -> dict[int, list[Result]]:
    """Return the results of a scene by what was asked for, all seeds together."""
    of_scene = [result for result in results if result["scene"] == scene]
    values = sorted({axis(result) for result in of_scene}, key=_rank)
    return {value: [result for result in of_scene if axis(result) == value] for value in values}


def _chart(
    title: str,
    x_label: str,
    name: str,
    results: Sequence[Result],
    axis: Callable[[Result], int],
    path: tuple[str, ...],
    factor: float,
) -> Chart:
    series: dict[str, Points] = {}
    for scene, label in list(scene_names(results).items())[:MAX_SERIES]:
        groups = _groups(results, scene, axis).values()
        costs = [compute_scaled_mean((pick(result, *path) for result in group), factor) for group in groups]
        series[label] = (costs, [mean_of(result["psnr"] for result in group) for group in groups])
    return Chart(f"{name}.svg", line_chart(series, title=title, x_label=x_label, y_label="PSNR, dB", dots=True), title)


def _table(
    title: str, note: str, label: str, results: Sequence[Result], axis: Callable[[Result], int], charts: Sequence[Chart]
) -> Table:
    scenes = scene_names(results)
    more = f" Images show {MAX_SERIES} of {len(scenes)} scenes." if len(scenes) > MAX_SERIES else ""
    rows = [
        (name, _name(value), *(column.cell(*group) for column in COLUMNS))
        for scene, name in scenes.items()
        for value, group in _groups(results, scene, axis).items()
    ]
    header = ("scene", label, *(column.header for column in COLUMNS))
    return Table(title, f"{note} Means over seeds.{more}", header, rows, charts=tuple(charts))
