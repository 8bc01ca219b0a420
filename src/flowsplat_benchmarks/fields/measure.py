"""Render held-out frames and views with a field, and score them; each image is scored once, whatever stops in between."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flowsplat.common.files import read_json, write_json
from flowsplat.common.progress import report
from flowsplat.evaluation.baselines import to_float
from flowsplat.evaluation.evaluate import find_heldout_mask
from flowsplat.evaluation.perceptual import lpips_metric
from flowsplat.evaluation.placement import view_camera
from flowsplat.evaluation.scores import Figures, score_image, summarize
from flowsplat.gaussians.renderer import Rendering
from flowsplat.geometry import Camera
from flowsplat.scenes import Scene
from flowsplat_benchmarks.fields.networks import Field
from flowsplat_benchmarks.fields.rays import cast_rays, find_bounds
from flowsplat_benchmarks.fields.volume import render_rays
from flowsplat_benchmarks.tables import text

SCORES = "scores.json"


@dataclass(frozen=True)
class FieldRenderer:
    """A trained field of a scene, which shows it as any model does."""

    field: Field
    scene: Scene

    def render(self, camera: Camera, t: float, flow_to: tuple[Camera, float] | None = None) -> Rendering:
        """See ``Renderer``; there is no flow."""
        scene, config = self.scene, self.field.config
        (near, far), similarity = find_bounds(scene), scene.similarity
        first, last = scene.timestamps[0], scene.timestamps[-1]
        rays = cast_rays(similarity.camera(camera), float((t - first) / (last - first)))
        color, alpha, depth = [], [], []
        with torch.no_grad():
            for start in range(0, len(rays), config.chunk):
                part = rays.part(start, start + config.chunk)
                _, fine = render_rays(self.field, part, near, far, config.samples, config.importance)
                color.append(fine.color)
                alpha.append(fine.alpha)
                depth.append(fine.depth)
        size = (camera.height, camera.width)
        covered = torch.cat(alpha)
        planar = torch.where(covered > 0, torch.cat(depth) / covered.clamp_min(1e-9), 0) / similarity.scale
        image = torch.cat(color).reshape(*size, 3).clamp(0, 1)
        return Rendering(image.numpy(), covered.reshape(size).numpy(), planar.reshape(size).numpy(), None)


def score_field(field: Field, scene: Scene, path: Path, key: str) -> dict[str, Any]:
    """Return the figures of a field on the images that its scene holds out: by other cameras where there are some, else frames.

    Args:
        path: of a file with the scores of the images that were measured before.
        key: a short name of everything that they depend on.

    Returns:
        ``kind`` (``views`` or ``frames``), ``figures`` (``evaluation.scores.summarize``, with ``moving``; None without any image),
        ``image_seconds`` (by the clock, the median), ``seconds`` (of all of it).

    Raises:
        InputError: the scene is damaged.
    """
    before = read_json(path) if path.exists() else {}
    known: dict[str, Any] = before.get("images", {}) if before.get("key") == key else {}
    renderer, overlay, (lpips, _) = FieldRenderer(field, scene), scene.overlay, lpips_metric()
    kind = "views" if scene.views else "frames"

    def score(name: str, camera: Camera, frame: int, target: np.ndarray, mask: np.ndarray | None) -> None:
        began = time.perf_counter()
        image = np.nan_to_num(renderer.render(camera, float(scene.timestamps[frame])).color)
        seconds = time.perf_counter() - began
        known[name] = {**score_image(image, target, {"moving": mask}, lpips, overlay), "seconds": seconds}
        write_json(path, {"key": key, "images": known})
        report(f"Image {name}: {text(known[name]['psnr'], 2)} dB, rendered in {seconds:,.1f} seconds.")

    if kind == "views":
        for view in scene.views:
            if view.name not in known:
                score(view.name, view_camera(scene, view), view.frame, to_float(scene.view_image(view)), scene.view_mask(view))
    else:
        for i in scene.heldout_frames:
            if f"{i:05d}" not in known:
                score(f"{i:05d}", scene.cameras[i], i, to_float(scene.heldout_frame(i)), find_heldout_mask(scene, i))
    images: list[Figures] = list(known.values())
    return {
        "kind": kind,
        "figures": summarize(images, ("moving",)),
        "image_seconds": statistics.median(image["seconds"] for image in images) if images else None,
        "seconds": sum(image["seconds"] for image in images),
    }
