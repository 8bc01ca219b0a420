"""All scenes of the priors benchmark, one after the other; called again, it continues."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flowsplat import __version__
from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_json
from flowsplat.common.progress import say
from flowsplat.protocols.priors.measure import measure
from flowsplat.protocols.priors.preparation import forget, prepare_scene
from flowsplat.protocols.priors.report import write_report, write_strip
from flowsplat.protocols.priors.scenes import BenchmarkScene, choose_scenes

FIGURES = "figures.json"


def run_priors_benchmark(root: Path, out: Path, names: Sequence[str] = (), again: bool = False) -> Path:
    """Prepare and measure scenes, and write ``OUT/<scene>/figures.json``, ``OUT/priors.md`` and ``OUT/priors.html``.

    ``figures.json`` holds ``scene``, ``kind``, ``tuned``, ``frames``, ``size``, ``flowsplat`` (version), ``figures`` by the keys of
    ``rows`` and, where one process did all of the work, ``seconds`` by stage.

    Args:
        root: the data root (see ``scenes``).
        names: the scenes to run; none = all. The report shows them and all others that were measured before.
        again: forget what is in OUT of these scenes.

    Returns:
        path of the page.

    Raises:
        InputError: the root or a scene cannot be used, or the folder cannot be written.
    """
    chosen = choose_scenes(root, names)
    make_folder(out)
    page = out
    for k, benchmark in enumerate(chosen):
        folder = out / benchmark.name
        if again:
            forget(folder)
        if (folder / FIGURES).exists():
            say(f"{benchmark.name}: measured already ({k + 1} of {len(chosen)}).")
        else:
            say(f"{benchmark.name} ({k + 1} of {len(chosen)}) ...")
            _measure_scene(benchmark, folder)
        page = write_report(out, _results(root, out))
    say(f"Look at {page}")
    return page


def _measure_scene(benchmark: BenchmarkScene, folder: Path) -> None:
    try:
        scene, needed = prepare_scene(benchmark, folder)
        figures = measure(benchmark, scene)
    except InputError as error:
        raise InputError(f"{benchmark.name}: {error}") from error
    write_strip(folder, benchmark, scene)
    figures |= {f"time.{name}": needed[name] for name in ("total", "cpu", "memory") if needed.get(name) is not None}
    result: dict[str, Any] = {
        "scene": benchmark.name, "kind": benchmark.kind, "tuned": benchmark.is_tuned, "frames": scene.num_frames,
        "size": [scene.width, scene.height], "flowsplat": __version__,
        "figures": {name: round(value, 4) for name, value in figures.items()},
    }  # fmt: skip
    if needed:
        result["seconds"] = {name: round(value, 2) for name, value in needed["seconds"].items()}
    write_json(folder / FIGURES, result)


def _results(root: Path, out: Path) -> list[dict[str, Any]]:
    """Of all scenes that were measured, in the order of the data root."""
    paths = [out / benchmark.name / FIGURES for benchmark in choose_scenes(root, ())]
    return [read_json(path) for path in paths if path.exists()]
