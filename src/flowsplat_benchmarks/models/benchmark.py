"""Run the motion models: everything but ``model.kind`` is the same for all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from flowsplat.common.devices import DeviceName, pick_device
from flowsplat.common.errors import InputError
from flowsplat.scenes.ingest import open_clip
from flowsplat_benchmarks.ablations.scenes import AblationScene, ablation_scenes, choose_scenes
from flowsplat_benchmarks.ablations.training_runs import comparable, list_training_runs
from flowsplat_benchmarks.datasets.cases import OWN_SUFFIX, rig_cases
from flowsplat_benchmarks.models.lineup import LINEUP, choose_entrants
from flowsplat_benchmarks.models.measure import measure_motion
from flowsplat_benchmarks.models.report import write_report
from flowsplat_benchmarks.models.times import MIN_FRAMES, list_heldout
from flowsplat_benchmarks.resume import BenchmarkOptions, measure_jobs, results_in
from flowsplat_benchmarks.tables import Result

PROTOCOL = "models"
SCENES = ("bear", "workshop", "street", "street-own", "dance-twirl")
SEEDS = (0, 1)
"""Of the random numbers of the runs."""
ITERATIONS = 1500
"""Frame-steps of every run."""
CLIP_SIDE = 427
"""Long side of the clips, pixels; a rendered scene keeps its own."""
MAX_GAUSSIANS = 100_000
"""Gaussians of every run, at most: with more a network over all of them is too slow for two cores."""


def run_models(
    root: Path,
    out: Path,
    models: Sequence[str] = (),
    scenes: Sequence[str] = SCENES,
    seeds: Sequence[int] = SEEDS,
    iterations: int = ITERATIONS,
    again: bool = False,
    options: BenchmarkOptions | None = None,
    device: DeviceName = "auto",
    with_base: bool = True,
    report_only: bool = False,
) -> Path:
    """Run or resume the models: one JSON a run, ``OUT/models.md`` and ``.html``, and an image of the first table.

    Args:
        root: the data root.
        models: names of models; none = all.
        scenes: names of scenes.
        seeds: every model is trained once with each.
        iterations: frame-steps of every run.
        again: forget the figures of these runs that are in OUT; prepared scenes stay.
        options: how many at a time, and by what.
        device: to train and measure on.
        with_base: whether the base is always among the models; without it each run can be a call of its own.
        report_only: run nothing, and show what is in OUT.

    Returns:
        path of the page, which shows all runs in OUT with these settings and steps.

    Raises:
        InputError: a name is not known, an input cannot be used, or the folder cannot be written.
    """
    if not report_only:
        pick_device(device)
    variants = [entrant.variant for entrant in choose_entrants(models, with_base)]
    known = list_scenes(root)
    wanted = [] if report_only else [hold_out(scene, device) for scene in choose_scenes(root, known, scenes)]
    runs = list_training_runs(PROTOCOL, wanted, variants, seeds, iterations, MAX_GAUSSIANS)
    jobs = [replace(run, measure_more=measure_motion).job(out) for run in runs]

    def compare() -> tuple[list[Result], int]:
        results = results_in(PROTOCOL, out)
        names = {result["scene"] for result in results}
        there = {scene.case.scene: scene for scene in wanted}
        there |= {scene.case.scene: hold_out(scene) for scene in known if scene.case.scene in names - set(there)}
        every = [entrant.variant for entrant in LINEUP]
        return comparable(results, PROTOCOL, list(there.values()), every, iterations, MAX_GAUSSIANS)

    def report(failed: Mapping[str, str]) -> Path:
        found, others = compare()
        return write_report(out, found, failed, others)

    return measure_jobs(jobs, out, report, "runs", again, options, device=device)


def list_scenes(root: Path) -> list[AblationScene]:
    """Return the scenes of the ablations, and beside each rendered one ``<scene>-own``: the same with priors of our own.

    Raises:
        InputError: no such folder.
    """
    known = ablation_scenes(root, CLIP_SIDE)
    rendered = {scene.case.scene for scene in known if scene.case.protocol == "rig"}
    own = rig_cases(root, sorted(rendered), priors="own") if rendered else []
    return [*known, *(AblationScene(replace(case, scene=case.scene + OWN_SUFFIX), None) for case in own)]


def hold_out(scene: AblationScene, device: DeviceName = "auto") -> AblationScene:
    """Return a scene with the frames of ``times`` held out, of rendered scenes beside their cameras from aside.

    Raises:
        InputError: the input cannot be used, or is too short for a gap.
    """
    case = scene.case
    count = open_clip(case.source, case.config.input).num_frames
    frames = list_heldout(count)
    if not frames:
        raise InputError(f"{case.scene} has {count} frames, too few to hold any out: take a clip of {MIN_FRAMES} or more.")
    options = replace(case.config.input, holdout_frames=frames)
    return replace(scene, case=replace(case, config=replace(case.config, input=options, device=device)))
