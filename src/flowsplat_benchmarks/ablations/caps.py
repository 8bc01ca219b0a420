"""Measure what more Gaussians and more frame-steps bring: PSNR against the cap, and against the steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from markupsafe import Markup

from flowsplat.common.errors import InputError
from flowsplat.evaluation.scores import mean_of
from flowsplat.images.charts import MAX_SERIES, Points, line_chart
from flowsplat_benchmarks.ablations.page import how_measured, scene_names, write_ablation_report
from flowsplat_benchmarks.ablations.scenes import ablation_scenes, choose_scenes
from flowsplat_benchmarks.ablations.training_runs import comparable, list_training_runs
from flowsplat_benchmarks.ablations.variants import Variant
from flowsplat_benchmarks.resume import BenchmarkOptions, measure_jobs, results_in
from flowsplat_benchmarks.tables import Chart, Column, Result, Table

PROTOCOL = "caps"
SCENES = ("bear", "train")
SEEDS = (0,)
"""Of the random numbers of the runs."""
CAPS = (50_000, 100_000, 200_000, 400_000, 600_000)
"""Gaussians at most, of the runs with different caps."""
STEPS = (250, 500, 1000, 1500, 3000)
"""Frame-steps of the runs with different numbers of steps."""
ITERATIONS = 1500
"""Frame-steps of the runs with different caps."""
STEPS_CAP = 200_000
"""Gaussians of the runs with different numbers of steps."""
CLIP_SIDE = 854
"""Long side of the clips, pixels; a rendered scene keeps its own."""

DENSE = {"init.background_spacing": 1.0, "init.foreground_spacing": 1.0}
"""Every pixel may start a Gaussian, so that it is the cap that says how many there are."""

REMARKS = (
    "The first Gaussians are placed as far apart as the cap asks, and are as much larger; their number falls a little while "
    "those that no camera sees are removed.",
)
COLUMNS = (
    Column("PSNR", ("psnr",), 2), Column("PSNR of objects", ("moving",), 2), Column("SSIM", ("ssim",), 3),
    Column("PSNR of training frames", ("training_psnr",), 2), Column("Gaussians at the end", ("gaussians", "total"), 0),
    Column("active, mean", ("gaussians", "active_mean"), 0), Column("seconds of training", ("seconds", "train"), 0),
    Column("peak memory, GiB", ("peak_memory_gib",), 1),
)  # fmt: skip


def make_capped_variant(cap: int, steps: int) -> Variant:
    """At most so many Gaussians, and so many frame-steps with the schedules stretched to them."""
    changes = {**DENSE, "density.max_gaussians": cap, "iterations": steps}
    return Variant(f"cap{cap}", f"at most {cap:,} Gaussians, {steps:,} steps", changes)


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
    """Run or resume the runs with different caps and steps: one JSON a run, ``OUT/caps.md`` and ``.html``, and both images.

    Args:
        root: the data root.
        caps: numbers of Gaussians, each with ``ITERATIONS`` steps.
        steps: numbers of frame-steps, each with ``STEPS_CAP`` Gaussians.
        size: long side of clips of DAVIS in pixels; 0 = as they are.
        again: forget the figures of these runs that are in OUT; prepared scenes stay.
        options: how many at a time, and by what.

    Returns:
        path of the page, which shows all runs in OUT with these settings and of this size.

    Raises:
        InputError: a number or a name cannot be used, or the folder cannot be written.
    """
    if any(value < 1 for value in (*caps, *steps)):
        raise InputError("--caps and --steps are numbers of Gaussians and of steps: 1 or more.")
    plan = dict.fromkeys([*((cap, ITERATIONS) for cap in caps), *((STEPS_CAP, count) for count in steps)])
    known = ablation_scenes(root, size)
    wanted = choose_scenes(root, known, scenes)
    jobs = [
        run.job(out)
        for run in list_training_runs(PROTOCOL, wanted, [make_capped_variant(*each) for each in plan], seeds, ITERATIONS, STEPS_CAP)
    ]

    def report(failed: Mapping[str, str]) -> Path:
        results = results_in(PROTOCOL, out)
        there = dict.fromkeys((result["cap"], result["iterations"]) for result in results)
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
    plans = (
        ("cap", "iterations", ITERATIONS, "Gaussians", "Gaussians at most"),
        ("iterations", "cap", STEPS_CAP, "frame-steps", "frame-steps"),
    )
    tables = []
    for axis, fixed, value, name, label in plans:
        chosen = [result for result in results if result[fixed] == value]
        if len({result[axis] for result in chosen}) > 1:
            scenes = scene_names(chosen)
            more = f" The image shows {MAX_SERIES} of {len(scenes)} scenes." if len(scenes) > MAX_SERIES else ""
            note = f"Each with {value:,} {'frame-steps' if fixed == 'iterations' else 'Gaussians at most'}. Means over seeds.{more}"
            tables.append(_table(f"PSNR against {name}", note, label, axis, chosen))
    verdict = f"Runs measured: {len(results)}."
    remarks = [*REMARKS, how_measured(results)] if results else []
    return write_ablation_report(out, PROTOCOL, "Gaussians and steps", verdict, remarks, tables, failed, others)


def _mean(results: Sequence[Result], scene: str, axis: str, value: int, figure: str) -> float | None:
    """Average a figure over the seeds."""
    return mean_of(result[figure] for result in results if result["scene"] == scene and result[axis] == value)


def _chart(title: str, x_label: str, axis: str, results: Sequence[Result]) -> Markup:
    values = sorted({result[axis] for result in results})
    series: dict[str, Points] = {
        label: (values, [_mean(results, scene, axis, value, "psnr") for value in values])
        for scene, label in list(scene_names(results).items())[:MAX_SERIES]
    }
    return line_chart(series, title=title, x_label=x_label, y_label="PSNR, dB", dots=True)


def _table(title: str, note: str, label: str, axis: str, results: Sequence[Result]) -> Table:
    rows = []
    for scene, name in scene_names(results).items():
        for value in sorted({result[axis] for result in results if result["scene"] == scene}):
            group = [result for result in results if result["scene"] == scene and result[axis] == value]
            rows.append((name, f"{value:,}", *(column.cell(*group) for column in COLUMNS)))
    header = ("scene", label, *(column.header for column in COLUMNS))
    return Table(title, note, header, rows, chart=Chart(f"{PROTOCOL}_{axis}.svg", _chart(title, label, axis, results)))
