"""How each cell is done: by the function of the benchmark that it belongs to."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_json
from flowsplat.common.source import source_state
from flowsplat.pipeline.config import RunConfig, preset
from flowsplat_benchmarks.ablations import benchmark as ablations
from flowsplat_benchmarks.ablations import caps
from flowsplat_benchmarks.ablations.claims import CLAIMS, list_needed_variants
from flowsplat_benchmarks.ablations.scenes import AblationScene, ablation_scenes, choose_scenes
from flowsplat_benchmarks.ablations.training_runs import TrainingRun
from flowsplat_benchmarks.ablations.variants import Variant
from flowsplat_benchmarks.clock import read_clock
from flowsplat_benchmarks.datasets.cases import davis_cases, rig_cases
from flowsplat_benchmarks.datasets.measure import measure_case
from flowsplat_benchmarks.fields import benchmark as fields
from flowsplat_benchmarks.fields.networks import FieldConfig
from flowsplat_benchmarks.models import benchmark as models
from flowsplat_benchmarks.models.lineup import choose_entrants
from flowsplat_benchmarks.models.measure import measure_motion
from flowsplat_benchmarks.objects import benchmark as objects
from flowsplat_benchmarks.oracles.benchmark import oracle_runs
from flowsplat_benchmarks.priors import benchmark as priors
from flowsplat_benchmarks.priors.scenes import choose_scenes as choose_prior_scenes
from flowsplat_benchmarks.results.cells import CLIP_SIDE, FIELD_TIMES, Cell, name_field
from flowsplat_benchmarks.scripts import growth

Figures = dict[str, Any]
ORACLE_STEPS = 1000
"""Frame-steps of what true priors are tried with."""
MAX_SHOWN_ERROR = 400
"""Characters of what a program said last. Chosen by eye."""


def list_missing(root: Path, cells: Iterable[Cell]) -> list[Cell]:
    """Return the cells whose scene is not under the data root.

    Raises:
        InputError: the root is no folder.
    """
    if not root.is_dir():
        raise InputError(f"{root} is no folder: give the data root, which holds davis/, rig/ and flow/.")
    return [cell for cell in cells if cell.needs and not (root / cell.folder).is_dir()]


def measure_cell(cell: Cell, root: Path, work: Path) -> Figures:
    """Do a cell in the folder ``work``, which others share, and return what its benchmark measured.

    Raises:
        InputError: the input cannot be used.
    """
    return JOBS[cell.benchmark](cell, root, make_folder(work))


def _with_seed(config: RunConfig, seed: int, **changes: Any) -> RunConfig:
    return replace(config, train=replace(config.train, seed=seed, **changes))


def _davis(cell: Cell, root: Path, work: Path) -> Figures:
    masks, _, side = cell.variant.partition("-")
    [case] = davis_cases(root, [cell.scene], "own" if masks == "own" else "given", config=_with_seed(preset("default"), cell.seed))
    if side:
        case = replace(case, config=replace(case.config, input=replace(case.config.input, resize=int(side))))
        if case.lent is not None:
            case = replace(case, lent=(case.lent[0], replace(case.lent[1], resize=int(side))))
    return measure_case(case, work / cell.name, work / f"{cell.name}.png")


def _rig(cell: Cell, root: Path, work: Path) -> Figures:
    config = _with_seed(preset("default"), cell.seed)
    [case] = rig_cases(root, [cell.scene], "true" if cell.variant == "true" else "own", config=config)
    return measure_case(case, work / cell.name, work / f"{cell.name}.png")


def _priors(cell: Cell, root: Path, work: Path) -> Figures:
    [scene] = choose_prior_scenes(root, [cell.scene])
    return priors.measure_scene(scene, work / cell.name)


def _oracles(cell: Cell, root: Path, work: Path) -> Figures:
    config = _with_seed(preset("default"), cell.seed, iterations=ORACLE_STEPS)
    [run] = oracle_runs(root, [cell.scene], [cell.variant], config=config)
    return run.job(work / "oracles").measure()


def _scene(cell: Cell, root: Path, side: int = CLIP_SIDE) -> AblationScene:
    return choose_scenes(root, ablation_scenes(root, side), [cell.scene])[0]


def _ablations(cell: Cell, root: Path, work: Path) -> Figures:
    variant = next(each for each in list_needed_variants(CLAIMS) if each.name == cell.variant)
    return _train(cell, _scene(cell, root), variant, ablations.ITERATIONS, ablations.MAX_GAUSSIANS, work)


def _caps(cell: Cell, root: Path, work: Path) -> Figures:
    count, _, is_steps = cell.variant.partition("-")
    cap, steps = (caps.STEPS_CAP, int(count)) if is_steps else (0 if count == "free" else int(count), caps.ITERATIONS)
    return _train(cell, _scene(cell, root), caps.make_capped_variant(cap, steps), caps.ITERATIONS, caps.STEPS_CAP, work)


def _train(cell: Cell, scene: AblationScene, variant: Variant, iterations: int, cap: int, work: Path) -> Figures:
    run = TrainingRun(cell.benchmark, scene, variant, variant.config(iterations, cap, cell.seed))
    return run.job(work / "trainings").measure()


def _models(cell: Cell, root: Path, work: Path) -> Figures:
    [entrant] = choose_entrants([cell.variant], with_base=False)
    scene = models.hold_out(choose_scenes(root, models.list_scenes(root), [cell.scene])[0])
    config = entrant.variant.config(models.ITERATIONS, models.MAX_GAUSSIANS, cell.seed)
    return TrainingRun("models", scene, entrant.variant, config, measure_motion).job(work / "trainings").measure()


def _fields(cell: Cell, root: Path, work: Path) -> Figures:
    """Train ``default`` first where nobody has: what that takes, or so many times that, is how long a field is trained."""
    scene, out = _scene(cell, root, fields.SIZE), make_folder(work / "fields")
    first = fields.default_run(scene, cell.seed).job(out)
    if not first.is_measured(out):
        write_json(first.file(out), {**first.measure(), "key": first.key})
    name, times = next(
        (field, times) for field in fields.FIELDS for times in FIELD_TIMES if name_field(field, times) == cell.variant
    )
    found = fields.FieldRun(scene, name, times, 0.0, cell.seed, FieldConfig()).job(out).measure()
    return {**found, "default": read_json(first.file(out))}


def _objects(cell: Cell, root: Path, work: Path) -> Figures:
    kind, _, world = cell.scene.partition("-")
    size = objects.WIDTH, objects.HEIGHT
    return objects.measure_world(
        int(world), work / cell.name, size, objects.FRAMES, again=False,
        kind={"plain": "any", "crowd": "crowd", "dancers": "dancers"}[kind],  # type: ignore[arg-type]
    )  # fmt: skip


def _growth(cell: Cell, root: Path, work: Path) -> Figures:
    kind, _, count = cell.scene.partition("-")
    folder = make_folder(work / cell.name)
    found = [case for case in growth.cases(folder, [kind], []) if case.kind == kind]
    wanted = next(case for case in found if int(count) == (case.frames if kind == "frames" else case.side))
    measured = growth.measure(wanted)
    return {name: value for name, value in measured.items() if name not in ("clip", "out")}  # records are shared: no folders


def _demo(cell: Cell, root: Path, work: Path) -> Figures:
    """Time the command as a user gives it. Its kernels are compiled already where another cell came before."""
    folder = work / cell.name
    shutil.rmtree(folder, ignore_errors=True)  # of an earlier measurement: the command would find all of it done
    began = read_clock()
    done = subprocess.run(
        [sys.executable, "-c", "from flowsplat.cli import main; main()", "demo", "-o", str(folder)], capture_output=True, text=True,
    )  # fmt: skip
    took = read_clock() - began
    if done.returncode:
        raise InputError(f"flowsplat demo ended with exit code {done.returncode}: {done.stderr.strip()[-MAX_SHOWN_ERROR:]}")
    metrics = read_json(folder / "own" / "metrics.json")
    return {"seconds": {"whole": round(took, 1)}, "peak_memory_gib": metrics["peak_memory_gib"], "flowsplat": source_state()}


JOBS: dict[str, Callable[[Cell, Path, Path], Figures]] = {
    "davis": _davis, "rig": _rig, "priors": _priors, "oracles": _oracles, "ablations": _ablations, "caps": _caps, "models": _models,
    "fields": _fields, "objects": _objects, "growth": _growth, "demo": _demo,
}  # fmt: skip


def make_job(cell: Cell, root: Path, work: Path) -> Callable[[], Figures]:
    """Return what does a cell, to be sent to another process."""
    return partial(measure_cell, cell, root, work)
