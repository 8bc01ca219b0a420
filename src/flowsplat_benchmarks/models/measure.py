"""Measure what tells motion models apart: held-out times by the length of the gap, views from aside, tracks, parameters."""

from __future__ import annotations

from typing import Any

from flowsplat.evaluation.scores import Figures, pick, summarize
from flowsplat.evaluation.tracks import track_errors
from flowsplat.gaussians.model import SceneModel
from flowsplat.scenes import Scene
from flowsplat_benchmarks.models.times import place_gaps


def measure_motion(model: SceneModel, scene: Scene, metrics: Figures) -> dict[str, Any]:
    """Return figures of a trained scene.

    Args:
        metrics: from ``evaluation.evaluate``.

    Returns:
        ``times`` and ``views`` (``psnr``, ``ssim``, ``count``, ``moving``, of views ``covisible`` too; None without any),
        ``gaps`` (as ``times``, by the length of the gap), ``flow`` (``mean`` and ``median`` in pixels, and both in ``moving``, of
        the flow to the next training frame against the truth), ``tracks`` (``evaluation.tracks``), ``parameters`` (``all``: how
        many numbers there are, ``shared``: of those the ones that no Gaussian has alone; ``bytes`` of all).
    """
    images = {image["frame"]: image for image in metrics["per_image"] if image["kind"] == "heldout_frame"}
    gaps = place_gaps(scene.num_frames)
    gaussians = model.gaussians
    shared = sum(value.numel() for value in gaussians.shared.values())
    total = shared + sum(value.numel() for value in gaussians.params.values())
    return {
        "times": metrics["heldout_frames"],
        "gaps": {name: summarize([images.get(i) for i in frames], ("moving",)) for name, frames in gaps.items()},
        "views": metrics["heldout_views"],
        "flow": pick(metrics, "flow_epe"),
        "tracks": track_errors(model, scene),
        "parameters": {"all": total, "shared": shared, "bytes": total * gaussians.params["means"].element_size()},
    }
