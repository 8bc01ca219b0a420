"""The ablations: what every part of the method is worth.

All rows train equally long, with one frame in every step and at most the same number of Gaussians. The paper's rows are run at our
own settings; compared are differences, not values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from flowsplat_benchmarks.ablations.claims import CLAIMS, choose_claims, list_needed_variants
from flowsplat_benchmarks.ablations.report import write_report
from flowsplat_benchmarks.ablations.scenes import ablation_scenes, choose_scenes
from flowsplat_benchmarks.ablations.training_runs import comparable, list_training_runs
from flowsplat_benchmarks.resume import BenchmarkOptions, measure_jobs, results_in

PROTOCOL = "ablations"
SCENES = ("train", "bear", "workshop")
SEEDS = (0, 1)
"""Of the random numbers of the runs of every row."""
ITERATIONS = 1500
"""Training steps of every run."""
CLIP_SIDE = 427
"""Long side of the clips, pixels; a rendered scene keeps its own."""
MAX_GAUSSIANS = 240_000
"""Gaussians of every run, at most."""


def run_ablations(
    root: Path,
    out: Path,
    rows: Sequence[str] = (),
    scenes: Sequence[str] = SCENES,
    seeds: Sequence[int] = SEEDS,
    iterations: int = ITERATIONS,
    again: bool = False,
    options: BenchmarkOptions | None = None,
) -> Path:
    """Run or resume the ablations: one JSON a run, ``OUT/ablations.md`` and ``.html``, and an image of each table.

    Args:
        root: the data root.
        rows: names of rows or tables; none = all.
        again: forget the figures of these runs that are in OUT; prepared scenes stay.
        options: how many at a time, and by what.

    Returns:
        path of the page, which shows all runs in OUT with these settings and steps.

    Raises:
        InputError: a name is not known, an input cannot be used, or the folder cannot be written.
    """
    claims, known = choose_claims(rows), ablation_scenes(root, CLIP_SIDE)
    wanted = choose_scenes(root, known, scenes)
    jobs = [
        run.job(out) for run in list_training_runs(PROTOCOL, wanted, list_needed_variants(claims), seeds, iterations, MAX_GAUSSIANS)
    ]

    def report(failed: Mapping[str, str]) -> Path:
        found, others = comparable(
            results_in(PROTOCOL, out), PROTOCOL, known, list_needed_variants(CLAIMS), iterations, MAX_GAUSSIANS
        )
        return write_report(out, found, failed, others)

    return measure_jobs(jobs, out, report, "runs", again, options)
