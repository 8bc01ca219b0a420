"""Measure all scenes of the priors benchmark, one after the other; called again, it continues."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from flowsplat.common.files import make_folder
from flowsplat.common.source import source_state
from flowsplat.pipeline.folder import stage_key
from flowsplat_benchmarks.priors.measure import measure
from flowsplat_benchmarks.priors.preparation import forget, prepare_scene, scene_config
from flowsplat_benchmarks.priors.report import write_report, write_strip
from flowsplat_benchmarks.priors.scenes import BenchmarkScene, choose_scenes
from flowsplat_benchmarks.resume import BenchmarkOptions, Measurement, measure_jobs, results_at


def run_priors_benchmark(
    root: Path, out: Path, names: Sequence[str] = (), again: bool = False, options: BenchmarkOptions | None = None
) -> Path:
    """Prepare scenes in ``OUT/<scene>/`` and measure them: ``OUT/<scene>.json``, ``OUT/priors.md`` and ``OUT/priors.html``.

    The JSON of a scene holds ``scene``, ``kind``, ``tuned``, ``frames``, ``size``, ``flowsplat`` (``source_state``), ``figures`` by
    the keys of ``rows`` and, where one process did all of the work, ``seconds`` by stage. A scene that cannot be measured is told
    and left out, and the others go on.

    Args:
        root: the data root (see ``scenes``).
        names: the scenes to run; none = all. The report shows them and all others that were measured before.
        again: forget what is in OUT of these scenes.
        options: how many at a time, and by what.

    Returns:
        path of the page.

    Raises:
        InputError: the root cannot be used, the folder cannot be written, or, at the end, which scenes could not be measured.
    """
    chosen = choose_scenes(root, names)
    make_folder(out)
    if again:
        for benchmark in chosen:
            (out / f"{benchmark.name}.json").unlink(missing_ok=True)
            forget(out / benchmark.name)
    jobs = [_job(benchmark, out / benchmark.name) for benchmark in chosen]

    def report(failed: Mapping[str, str]) -> Path:
        return write_report(out, _results(root, out), failed)

    return measure_jobs(jobs, out, report, options=options)


def _job(benchmark: BenchmarkScene, folder: Path) -> Measurement:
    config = scene_config(benchmark)
    return Measurement(
        benchmark.name, stage_key(benchmark.kind, config.input, config.priors), partial(measure_scene, benchmark, folder)
    )


def measure_scene(benchmark: BenchmarkScene, folder: Path) -> dict[str, Any]:
    """Prepare a scene in ``folder``, measure it and return what its JSON holds (see ``run_priors_benchmark``).

    Raises:
        InputError: the input cannot be used.
    """
    scene, needed = prepare_scene(benchmark, folder)
    figures = measure(benchmark, scene)
    write_strip(folder, benchmark, scene)
    figures |= {f"time.{name}": needed[name] for name in ("total", "cpu", "memory") if needed.get(name) is not None}
    result: dict[str, Any] = {
        "scene": benchmark.name, "kind": benchmark.kind, "tuned": benchmark.is_tuned, "frames": scene.num_frames,
        "size": [scene.width, scene.height], "flowsplat": source_state(),
        "figures": {name: round(value, 4) for name, value in figures.items()},
    }  # fmt: skip
    if needed:
        result["seconds"] = {name: round(value, 2) for name, value in needed["seconds"].items()}
    return result


def _results(root: Path, out: Path) -> list[dict[str, Any]]:
    """Collect the results of all scenes that were measured, in the order of the data root."""
    return results_at(out / f"{benchmark.name}.json" for benchmark in choose_scenes(root, ()))
