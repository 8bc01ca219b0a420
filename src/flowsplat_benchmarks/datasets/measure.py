"""Measure one case: an ordinary run, and what it reached as one JSON."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.source import source_state
from flowsplat.evaluation.tracks import track_errors
from flowsplat.gaussians.model import SceneModel
from flowsplat.images.sheets import stack
from flowsplat.pipeline import evaluate_run, load, prepare, train
from flowsplat.pipeline.folder import RunFolder
from flowsplat.scenes import Scene
from flowsplat.scenes.formats.rig import RigTruth
from flowsplat.scenes.ingest import open_clip
from flowsplat.scenes.layers import read_image, write_image
from flowsplat_benchmarks.datasets.cases import Case
from flowsplat_benchmarks.datasets.dycheck import measure_dycheck

MOTION = ("flow_epe", "prior_flow_epe", "flow_prior_epe", "depth_abs_rel")
"""Errors of flow and depth (``evaluation.evaluate``)."""
TIMED_IMAGES = 5
"""Images that are rendered to tell how many there are in a second. Chosen by eye."""


def measure_case(case: Case, folder: Path, strip: Path) -> dict[str, Any]:
    """Run or resume a case in ``folder``, and draw its strip.

    Returns:
        ``name``, ``protocol``, ``scene``, ``form``, ``variant``, ``settings``, ``tuned``, ``flowsplat`` (``source_state``),
        ``frames``, ``size``, ``test`` (``kind``, ``count``), ``ours`` and each of ``baselines``: ``psnr``, ``ssim``, ``lpips``,
        ``moving``, ``covisible``; ``refined`` (ours with the poses of held-out frames refined; None for held-out cameras);
        ``training_frames`` and ``MOTION`` (see ``evaluation.evaluate``), ``tracks`` (see ``evaluation.tracks``), ``dycheck`` (of
        that protocol, see ``dycheck.measure_dycheck``), ``gaussians``, ``images_a_second``, ``seconds`` by stage,
        ``peak_memory_gib``, ``lpips_reason``, ``verdicts``.

    Raises:
        InputError: the input cannot be used.
    """
    run = prepare(case.source, folder, case.config)
    _lend_masks(case, Scene(run.scene_path))
    train(run)
    metrics = evaluate_run(run)
    scene, model = Scene(run.scene_path), load(run.path, case.config.device)
    kind = "views" if scene.views else "frames"
    name = "heldout_views" if scene.views else "heldout_frames"
    _write_strip(run, metrics, kind, strip)
    return {
        "name": case.name, "protocol": case.protocol, "scene": case.scene, "form": case.form, "variant": case.variant,
        "settings": case.settings, "tuned": case.is_tuned, "flowsplat": source_state(),
        "frames": scene.num_frames, "size": [scene.width, scene.height],
        "test": {"kind": kind, "count": (metrics[name] or {}).get("count", 0)},
        "ours": metrics[name], "refined": None if scene.views else metrics["heldout_frames_refined"],
        "baselines": metrics["baselines_views" if scene.views else "baselines"] or {},
        **{key: metrics.get(key) for key in ("training_frames", *MOTION, "lpips_reason")},
        "tracks": track_errors(model, scene, _births(case)),
        **({"dycheck": measure_dycheck(model, scene, case.source)} if case.protocol == "dycheck" else {}),
        "gaussians": {key: metrics["gaussians"][key] for key in ("total", "active_mean")},
        "images_a_second": _images_a_second(model, scene),
        "seconds": run.seconds, "peak_memory_gib": metrics["peak_memory_gib"],
        "verdicts": {name: (scene.prior(name) or {}).get("verdict", "") for name in ("cameras", "depth", "masks")},
    }  # fmt: skip


def _lend_masks(case: Case, scene: Scene) -> None:
    """Given masks of held-out frames, for the region metrics: no prior and no training can reach them."""
    if case.lent is None:
        return
    clip = open_clip(*case.lent)
    for i in scene.heldout_frames:
        if not scene.heldout_masks.has_mask(i):
            scene.heldout_masks.write_mask(i, clip.mask(i))


def _births(case: Case) -> np.ndarray | None:
    if case.protocol != "rig":
        return None
    clip = open_clip(case.source, case.config.input)
    assert isinstance(clip.truth, RigTruth)
    return clip.truth.births


def _images_a_second(model: SceneModel, scene: Scene) -> float:
    """Time images of the clip's size, in color and depth, from cameras of the clip; the median after a first one, which may
    compile."""
    seconds = []
    model.render(scene.cameras[scene.train_frames[0]], float(scene.timestamps[scene.train_frames[0]]))
    for i in scene.train_frames[:: max(1, len(scene.train_frames) // TIMED_IMAGES)]:
        start = time.perf_counter()
        model.render(scene.cameras[i], float(scene.timestamps[i]))
        seconds.append(time.perf_counter() - start)
    return round(1 / float(np.median(seconds)), 2)


def _write_strip(run: RunFolder, metrics: dict[str, Any], kind: str, path: Path) -> None:
    """Target, rendering and error of the test image of median PSNR, and of the worst one below it."""
    folder, wanted = ("views", "heldout_view") if kind == "views" else ("heldout", "heldout_frame")
    tested = sorted((p for p in metrics["per_image"] if p["kind"] == wanted), key=lambda p: p["psnr"])
    chosen = [tested[len(tested) // 2], tested[0]] if len(tested) > 1 else tested
    sheets = [run.path / "evaluation" / folder / f"{image['name']}_sheet.png" for image in chosen]
    rows = [read_image(sheet) for sheet in sheets if sheet.exists()]
    if rows:
        write_image(path, stack(rows))
