"""Measure many random worlds; called again, it continues."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError
from flowsplat.common.files import write_json
from flowsplat.common.source import source_state
from flowsplat.scenes import Scene
from flowsplat_benchmarks.objects.measure import measure_scene
from flowsplat_benchmarks.objects.preparation import VARIANTS, WorldKind, place_objects, prepare_world
from flowsplat_benchmarks.objects.tables import DEFINITIONS, tables
from flowsplat_benchmarks.reports import Report, failures
from flowsplat_benchmarks.resume import BenchmarkOptions, Measurement, measure_jobs, results_at
from flowsplat_benchmarks.tables import describe_version
from flowsplat_benchmarks.worlds import read_objects

DEFAULT_PROCESSES = 2
"""Worlds that are worked on at a time where the options do not say it."""

FIGURES = "figures.json"
"""In the folder of a world."""

TITLE = "Objects of random worlds"
WIDTH, HEIGHT, FRAMES = 320, 180, 40
"""Pixels, and frames of a world."""


def run_objects_benchmark(
    out: Path, worlds: int, seed: int, again: bool = False, size: tuple[int, int] = (WIDTH, HEIGHT), frames: int = FRAMES,
    options: BenchmarkOptions | None = None, kind: WorldKind = "any",
) -> Path:  # fmt: skip
    """Measure the worlds of ``worlds`` seeds from ``seed`` on: ``OUT/results.json``, ``OUT/objects.md`` and ``OUT/objects.html``.

    Of each, ``OUT/<seed>/own`` and ``OUT/<seed>/true`` are its scenes and ``OUT/<seed>/figures.json`` its figures (see
    ``measure_scene``). A world that cannot be prepared is told and left out, and the others go on.

    Args:
        again: place the objects anew in what is prepared already, and measure them.
        size: pixels of the images, frames: how many.
        options: how many at a time, and by what.
        kind: of the worlds. Those of dancers and crowds lie in ``OUT/dancers-<seed>`` and ``OUT/crowd-<seed>``.

    Returns:
        path of the page.

    Raises:
        InputError: the folder cannot be written, or, at the end, which worlds could not be measured.
    """
    if worlds < 1 or seed < 0:
        raise InputError(f"--worlds {worlds} --seed {seed}: give one world or more, and a seed of 0 or more.")
    seeds = range(seed, seed + worlds)
    jobs = [_job(each, out, size, frames, again, kind) for each in seeds]

    def report(failed: Mapping[str, str]) -> Path:
        return write_report(out, seeds, failed, kind)

    return measure_jobs(jobs, out, report, "worlds", again, options, workers=DEFAULT_PROCESSES)


def _name(seed: int, kind: WorldKind) -> str:
    return str(seed) if kind == "any" else f"{kind}-{seed}"


def _job(seed: int, out: Path, size: tuple[int, int], frames: int, again: bool, kind: WorldKind) -> Measurement:
    folder = out.absolute() / _name(seed, kind)
    work = partial(measure_world, seed, folder, size, frames, again, kind)
    return Measurement(f"world-{_name(seed, kind)}", "", work, folder / FIGURES)


def measure_world(
    seed: int, folder: Path, size: tuple[int, int], frames: int, again: bool, kind: WorldKind = "any"
) -> dict[str, Any]:
    """Prepare what is missing of a world, place its objects and return what ``FIGURES`` in its folder says.

    Raises:
        InputError: as ``prepare_world``.
    """
    prepare_world(seed, folder, *size, frames, kind)
    figures: dict[str, Any] = {}
    for variant in VARIANTS:
        scene = Scene(folder / variant)
        place_objects(scene, again)
        figures[variant] = _round(measure_scene(scene))
        truth = scene.truth
        assert truth is not None
        known = read_objects(truth)
    facts = {"seed": seed, "ground": known["ground"], "camera": known["camera"], "size": size, "frames": frames}
    return {**facts, "flowsplat": source_state(), **figures}


def _round(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 5)
    if isinstance(value, dict):
        return {key: _round(each) for key, each in value.items()}
    return [_round(each) for each in value] if isinstance(value, list) else value


def write_report(out: Path, seeds: range, failed: Mapping[str, str], kind: WorldKind = "any") -> Path:
    """Write the tables of all seeds that are measured, and return the path of the page.

    Raises:
        InputError: the folder cannot be written.
    """
    names = [_name(each, kind) for each in seeds]
    results = results_at(out / name / FIGURES for name in names if f"world-{name}" not in failed)
    write_json(out / "results.json", results)
    of = "" if kind == "any" else f" of {kind}"
    verdict = f"{len(results)} worlds{of}, seeds {seeds.start} to {seeds.stop - 1}."
    remarks = [*DEFINITIONS, *([describe_version(results)] if results else []), *failures(failed, "measured")]
    return Report("objects", TITLE, verdict, remarks, tables(results), verdict_is_remark=True).write(out)
