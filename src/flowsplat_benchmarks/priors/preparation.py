"""The priors of one scene, computed as ``flowsplat prepare`` does, in a process of its own that tells what it needed."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

from flowsplat.common.files import make_folder, read_json, write_json
from flowsplat.common.memory import peak_memory
from flowsplat.common.processes import in_own_process
from flowsplat.pipeline import RunConfig, prepare
from flowsplat.priors.flow import flow_stage
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.ingest import ingest, open_clip
from flowsplat_benchmarks.priors.scenes import BenchmarkScene

NEEDED = "needed.json"
"""Seconds of every stage, all of them, those of the processor, and memory; only where one process did all of the work."""
WHOLE_SIZE = 0
"""``resize`` that keeps the size: a pair of images is compared with measured flow."""


def prepare_scene(scene: BenchmarkScene, folder: Path) -> tuple[Scene, dict[str, Any]]:
    """Compute or complete the priors of a scene in ``folder``.

    Rig scenes train on all frames; DAVIS clips hold out every tenth, as a run does, and come without their masks.

    Returns:
        the prepared scene; and ``seconds`` by stage, ``total``, ``cpu`` (seconds) and ``memory`` (GiB), or nothing where
        the work was interrupted.

    Raises:
        InputError: the input cannot be used.
    """
    in_own_process(_prepare_here, scene, folder)
    needed = read_json(folder / NEEDED) if (folder / NEEDED).exists() else {}
    return Scene(folder / "scene"), needed


def scene_config(scene: BenchmarkScene) -> RunConfig:
    """With which settings a scene is prepared."""
    if scene.kind == "pair":
        return RunConfig(input=InputOptions(resize=WHOLE_SIZE))
    return RunConfig(input=InputOptions(holdout=None)) if scene.kind == "rig" else RunConfig()


def forget(folder: Path) -> None:
    """Remove what was prepared and measured in the folder of a scene."""
    if (folder / "run.json").exists() or (folder / "scene" / "scene.json").exists():
        shutil.rmtree(folder)


def _prepare_here(scene: BenchmarkScene, folder: Path) -> None:
    is_new = not folder.exists() or not any(folder.iterdir())
    before = _read_key(folder)
    wall, processor = time.perf_counter(), time.process_time()
    seconds = _flow_only(scene, folder) if scene.kind == "pair" else _all_priors(scene, folder)
    if is_new:
        total, cpu = time.perf_counter() - wall, time.process_time() - processor
        write_json(folder / NEEDED, {"seconds": seconds, "total": total, "cpu": cpu, "memory": peak_memory()})
    elif _read_key(folder) != before:
        (folder / NEEDED).unlink(missing_ok=True)


def _read_key(folder: Path) -> str | None:
    """The key of the settings that a finished preparation had."""
    path = folder / "run.json"
    return read_json(path)["stages"].get("prepare", {}).get("key") if path.exists() else None


def _all_priors(scene: BenchmarkScene, folder: Path) -> dict[str, float]:
    return prepare(scene.source, folder, scene_config(scene)).seconds


def _flow_only(scene: BenchmarkScene, folder: Path) -> dict[str, float]:
    options = scene_config(scene).input
    prepared = ingest(open_clip(scene.source, options), make_folder(folder) / "scene", options)
    start = time.perf_counter()
    flow_stage(prepared)
    return {"flow": time.perf_counter() - start}
