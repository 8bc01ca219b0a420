"""Run all oracles of rendered scenes, each trained and measured on the held-out cameras; called again, it continues."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError
from flowsplat.common.source import source_state
from flowsplat.evaluation.scores import pick
from flowsplat.pipeline import RunConfig, evaluate_run, prepare, train
from flowsplat.pipeline.config import check
from flowsplat.pipeline.folder import stage_key
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.layers import write_image
from flowsplat_benchmarks.datasets.cases import Case, rig_cases
from flowsplat_benchmarks.oracles.classes import error_sheet, static_depth_errors, view_errors
from flowsplat_benchmarks.oracles.objects import depth_scale, masks_of, object_depth_errors, static_error
from flowsplat_benchmarks.oracles.quick import is_world
from flowsplat_benchmarks.oracles.report import SHEET, write_report
from flowsplat_benchmarks.oracles.scenes import ORACLES, make_oracle, require_oracles
from flowsplat_benchmarks.priors.measure import compute_pooled_iou
from flowsplat_benchmarks.resume import BenchmarkOptions, Measurement, measure_jobs, results_in
from flowsplat_benchmarks.shared_scenes import prepare_scene

PROTOCOL = "oracles"
FOLDER = "scenes"
"""In OUT, where the prepared scenes and their oracles are."""


@dataclass(frozen=True)
class OracleRun:
    """An oracle of a scene, and how it is trained.

    Attributes:
        case: the scene with own priors.
        oracle: a name from ``ORACLES``.
    """

    case: Case
    oracle: str

    @property
    def name(self) -> str:
        """Of its folder and files."""
        config = self.case.config.train
        preset = self.case.settings.split(",")[0]
        return f"{self.case.scene}_{self.oracle}_{preset}_{config.iterations}-steps_seed{config.seed}"

    def job(self, out: Path) -> Measurement:
        """Prepare the scene in ``out`` where it is not yet, make the oracle, train and measure."""
        config = self.case.config
        key = stage_key(self.case.scene, self.oracle, config.input, config.priors, config.train)
        return Measurement(f"{PROTOCOL}_{self.name}", key, partial(self._measure, out))

    def _measure(self, out: Path) -> dict[str, Any]:
        return measure_oracle(self, prepare_scene(self.case, out / FOLDER / self.case.scene), out)

    def forget(self, out: Path) -> None:
        """Remove the run and the oracle scene that it was made from; the prepared scene stays."""
        for path in (out / self.name, self.scene_path(out)):
            if (path / "run.json").exists() or (path / "scene.json").exists():
                shutil.rmtree(path)

    def scene_path(self, out: Path) -> Path:
        """Return the oracle scene."""
        return out / FOLDER / f"{self.case.scene}_{self.oracle}"


def run_oracles(
    root: Path,
    out: Path,
    scenes: Sequence[str] = (),
    oracles: Sequence[str] = (),
    preset_name: str = "default",
    config: RunConfig | None = None,
    again: bool = False,
    options: BenchmarkOptions | None = None,
) -> Path:
    """Run or resume the oracles: one JSON and one run each, ``OUT/oracles.md`` and ``.html``.

    ``OUT/scenes/<scene>`` is the prepared scene, ``OUT/scenes/<scene>_<oracle>`` the scene with true priors in place of its own,
    and ``OUT/<scene>_<oracle>_...`` an ordinary run on it, with the rendered held-out views in ``evaluation/views``.

    Args:
        root: the data root, with ``rig/<scene>``.
        scenes: their names; none = all.
        oracles: names from ``ORACLES``; none = all.
        preset_name: the name of the settings of training.
        config: with the training and the device to use; None = the preset's.
        again: forget runs, figures and oracle scenes that are in OUT of these; prepared scenes stay.
        options: how many at a time, and by what.

    Returns:
        path of the page, which shows all runs in OUT with these settings.

    Raises:
        InputError: a name or a setting cannot be used, or the folder cannot be written.
    """
    runs = list(oracle_runs(root, scenes, oracles, preset_name, config))
    if again:
        for run in runs:
            run.forget(out)
    settings = runs[0].case.settings

    def report(failed: Mapping[str, str]) -> Path:
        results = results_in(PROTOCOL, out)
        same = [result for result in results if result["settings"] == settings]
        return write_report(out, same, failed, len(results) - len(same))

    return measure_jobs([run.job(out) for run in runs], out, report, "runs", again, options, device=runs[0].case.config.device)


def oracle_runs(
    root: Path, scenes: Sequence[str], oracles: Sequence[str], preset_name: str = "default", config: RunConfig | None = None
) -> Iterator[OracleRun]:
    """Yield those that are asked for, scene by scene, in the order in which oracles add to each other.

    Raises:
        InputError: as ``run_oracles``.
    """
    require_oracles(oracles)
    if worlds := [name for name in scenes if is_world(name)]:
        raise InputError(f"World {worlds[0]} has no held-out cameras to measure training by: use --quick.")
    for case in rig_cases(root, scenes, "own", preset_name, config):
        check(case.config)
        plain = replace(case, config=replace(case.config, baselines="simple", refine_poses=False))
        for oracle in ORACLES:
            if oracle in oracles or not oracles:
                yield OracleRun(plain, oracle)


def measure_oracle(run: OracleRun, prepared: Path, out: Path) -> dict[str, Any]:
    """Make the oracle of the prepared scene, train and measure it, or what is missing of that.

    Returns:
        ``protocol``, ``scene``, ``size``, ``frames``, ``tuned``, ``oracle``, ``settings``, ``seed``, ``iterations``, ``flowsplat``
        (``source_state``), ``run`` (name of its folder); ``views`` (how many), ``psnr``, ``ssim``, ``moving``, ``covisible`` (PSNR)
        of the held-out cameras and ``training_psnr``; ``mask_iou``, ``scale`` (units of the scene per unit of the truth),
        ``static`` (``static_error``), ``static_classes`` (``static_depth_errors``) and ``objects`` (``object_depth_errors``) of its
        priors; ``classes`` (``view_errors``) of the held-out views; ``gaussians`` and ``seconds`` by stage.

    Raises:
        InputError: the scene has no truth, or the folder cannot be written.
    """
    config = replace(run.case.config, input=InputOptions())
    scene = make_oracle(prepared, run.scene_path(out), run.oracle, config.device)
    folder = out / run.name
    if (folder / "scene" / "scene.json").exists() and Scene(folder / "scene").info.oracle != scene.info.oracle:
        shutil.rmtree(folder)
    trained = prepare(scene.folder, folder, config)
    train(trained)
    metrics = evaluate_run(trained)
    tested, renders = metrics["heldout_views"], trained.path / "evaluation" / "views"
    _write_sheet(scene, renders, metrics, trained.path / SHEET)
    return {
        "protocol": PROTOCOL, "scene": run.case.scene, "size": [scene.width, scene.height], "frames": scene.num_frames,
        "tuned": run.case.is_tuned, "oracle": run.oracle, "settings": run.case.settings, "seed": config.train.seed,
        "iterations": config.train.iterations, "flowsplat": source_state(), "run": run.name,
        "views": pick(tested, "count") or 0, "psnr": pick(tested, "psnr"), "ssim": pick(tested, "ssim"),
        **{region: pick(tested, region, "psnr") for region in ("moving", "covisible")},
        "training_psnr": pick(metrics, "training_frames", "psnr"),
        "mask_iou": compute_pooled_iou((own, true) for _, own, true in masks_of(scene)),
        "scale": depth_scale(scene), "static": static_error(scene), "static_classes": static_depth_errors(scene),
        "classes": view_errors(scene, renders),
        "objects": [asdict(error) for error in object_depth_errors(scene)],
        "gaussians": metrics["gaussians"]["total"], "seconds": trained.seconds,
    }  # fmt: skip


def _write_sheet(scene: Scene, renders: Path, metrics: dict[str, Any], path: Path) -> None:
    """The view of median PSNR, and under it the worst one."""
    tested = sorted((p for p in metrics["per_image"] if p["kind"] == "heldout_view"), key=lambda p: float(p["psnr"]))
    chosen = [tested[k]["name"] for k in sorted({len(tested) // 2, 0}, reverse=True)] if tested else []
    sheet = error_sheet(scene, renders, chosen)
    if sheet is not None:
        write_image(path, sheet)
