"""What faults of masks cost in distance, without training: of rendered scenes and of random worlds."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.source import source_state
from flowsplat.pipeline import RunConfig
from flowsplat.pipeline.folder import stage_key
from flowsplat.scenes import Scene
from flowsplat_benchmarks.datasets.cases import Case, rig_cases
from flowsplat_benchmarks.objects.benchmark import FRAMES, HEIGHT, WIDTH
from flowsplat_benchmarks.objects.measure import depth_scale, measure_objects
from flowsplat_benchmarks.objects.preparation import WorldKind, place_objects, prepare_world
from flowsplat_benchmarks.oracles import objects as rendered
from flowsplat_benchmarks.oracles.quick_report import write_quick_report
from flowsplat_benchmarks.oracles.scenes import CHAINS, ORACLES, make_oracle, require_oracles
from flowsplat_benchmarks.resume import BenchmarkOptions, Measurement, measure_jobs, results_in
from flowsplat_benchmarks.shared_scenes import prepare_scene

PROTOCOL = "oracles-quick"
"""In the names of files."""
FOLDER = "scenes"
"""In OUT, where the prepared scenes and their oracles are: that of the trained oracles, too."""
MAX_TUNING_SEED = 899
"""Worlds of higher seeds are never looked at one by one."""

_WORLD = re.compile(rf"({'|'.join(get_args(WorldKind))})-(\d+)")


@dataclass(frozen=True)
class World:
    """A random world, by its kind and seed."""

    kind: WorldKind
    seed: int

    @property
    def name(self) -> str:
        """By which it is asked for."""
        return f"{self.kind}-{self.seed}"


def is_world(name: str) -> bool:
    """Return whether a name is that of a random world."""
    return _WORLD.fullmatch(name) is not None


def parse_worlds(names: Sequence[str]) -> tuple[list[World], list[str]]:
    """Return the worlds among some names (``crowd-3``), and the other names.

    Raises:
        InputError: a world is one of those that are not looked at one by one.
    """
    worlds, others = [], []
    for name in names:
        found = _WORLD.fullmatch(name)
        if found is None:
            others.append(name)
            continue
        kind, seed = next(each for each in get_args(WorldKind) if each == found[1]), int(found[2])
        if seed > MAX_TUNING_SEED:
            raise InputError(f"World {name} is not looked at by itself: choose a seed of {MAX_TUNING_SEED} or less.")
        worlds.append(World(kind, seed))
    return worlds, others


def run_quick_oracles(
    root: Path, out: Path, scenes: Sequence[str] = (), oracles: Sequence[str] = (), config: RunConfig | None = None,
    again: bool = False, options: BenchmarkOptions | None = None,
) -> Path:  # fmt: skip
    """Measure the distance of every object in each oracle, without training: a JSON a scene and ``OUT/oracles_quick.md``.

    Args:
        root: the data root, with ``rig/<scene>``.
        scenes: their names, or those of random worlds (``any-3``, ``crowd-3``, ``dancers-3``); none = all of the root.
        oracles: names from ``ORACLES``; none = own and those of the masks.
        config: with the device to use; None = the default.
        again: measure what is measured already anew; prepared scenes and oracles stay.
        options: how many at a time, and by what.

    Returns:
        path of the page, which shows all scenes in OUT.

    Raises:
        InputError: a name cannot be used, or the folder cannot be written.
    """
    require_oracles(oracles)
    chosen = [oracle for oracle in ORACLES if oracle in (oracles or CHAINS[1])]
    sources = list(_find_sources(root, scenes, config))
    jobs = [_make_job(source, chosen, out.absolute(), (config or RunConfig()).device) for source in sources]

    def report(failed: Mapping[str, str]) -> Path:
        return write_quick_report(out, results_in(PROTOCOL, out), failed)

    return measure_jobs(jobs, out, report, "scenes", again, options)


def _find_sources(root: Path, scenes: Sequence[str], config: RunConfig | None) -> Iterator[Case | World]:
    worlds, names = parse_worlds(scenes)
    if names or not worlds:
        yield from rig_cases(root, names, "own", "default", config)
    yield from worlds


def _make_job(source: Case | World, oracles: Sequence[str], out: Path, device: str) -> Measurement:
    name = source.scene if isinstance(source, Case) else source.name
    settings = (source.config.input, source.config.priors) if isinstance(source, Case) else (source,)
    return Measurement(
        f"{PROTOCOL}_{name}", stage_key(name, list(oracles), *settings), partial(_measure, source, oracles, out, device)
    )


def _measure(source: Case | World, oracles: Sequence[str], out: Path, device: str) -> dict[str, Any]:
    """Return ``protocol``, ``scene``, ``tuned``, ``flowsplat`` and by oracle what ``measure_distances`` says."""
    if isinstance(source, Case):
        name, prepared = source.scene, prepare_scene(source, out / FOLDER / source.scene)
    else:
        name, prepared = source.name, out / FOLDER / source.name / "own"
        prepare_world(source.seed, prepared.parent, WIDTH, HEIGHT, FRAMES, source.kind)
        place_objects(Scene(prepared))
    found = {}
    for oracle in oracles:
        folder = out / FOLDER / f"{name}_{oracle}"
        found[oracle] = measure_distances(make_oracle(prepared, folder, oracle, device), isinstance(source, World))
    tuned = isinstance(source, World) or source.is_tuned
    return {"protocol": PROTOCOL, "scene": name, "tuned": tuned, "flowsplat": source_state(), "oracles": found}


def measure_distances(scene: Scene, by_static_depth: bool) -> dict[str, Any]:
    """Return how far off the objects of a scene with truth are.

    Args:
        by_static_depth: true depth comes to the scale of the scene by what rests (``measure.depth_scale``), as in all figures of
            random worlds, whose camera may stand still; else by the camera paths (``objects.depth_scale``).

    Returns:
        ``idf1`` of all objects, ``static``: median of |ln(estimated / true depth)| of what rests by our masks and by the true ones;
        and the ``objects`` in the order of their numbers, as ``measure.measure_objects`` has them.

    Raises:
        InputError: something of the scene is missing.
    """
    truth, frames = rendered.truth_of(scene), scene.train_frames
    scale = depth_scale(scene) if by_static_depth else 1 / rendered.depth_scale(scene)
    true, ours = (np.stack([layers.mask(i) for i in frames]) for layers in (truth, scene))
    log = np.stack([np.log(scale * scene.depth(i).depth / truth.depth(i).depth) for i in frames])
    objects, idf1 = measure_objects(true, ours, log, int(true.max()))
    rests = (true == 0) & (ours == 0)
    return {"idf1": idf1, "static": float(np.median(np.abs(log[rests]))) if rests.any() else None, "objects": objects}
