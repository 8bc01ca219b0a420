"""The clip's cameras as a COLMAP text model, and the centers of the background as its points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from flowsplat.common.files import write_text
from flowsplat.common.registry import Entry
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera
from flowsplat.geometry.rotations import rotations_to_quats
from flowsplat.output.export.cameras import frame_names
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.export.still import Still, middle_or, still_at
from flowsplat.scenes import Scene

MAX_POINTS = 100_000
"""Points that are written, at most, evenly chosen. A round number."""


def write(folder: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """Write the text model, whose image path is the folder of the scene."""
    resting = model.gaussians.select(torch.nonzero(model.gaussians.at_rest).squeeze(1))
    write_colmap(
        folder, scene, still_at(replace(model, gaussians=resting) if len(resting) else model, middle_or(model, options.time))
    )


def estimate_bytes(model: SceneModel, scene: Scene, options: ExportOptions) -> int:
    """Return about how many it will be."""
    return 150 * scene.num_frames + 40 * min(model.active_count(middle_or(model, options.time)), MAX_POINTS)


def write_colmap(folder: Path, scene: Scene, points: Still) -> None:
    """``cameras.txt``, ``images.txt`` and ``points3D.txt``; the image path is the folder of the scene.

    Args:
        folder: gets the three files.
        scene: with cameras.
        points: their centers and colors become points without tracks, to start a training from.

    Raises:
        InputError: the scene has no cameras, or the folder cannot be written.
    """
    lenses: dict[str, int] = {}
    images = []
    for number, (camera, name) in enumerate(zip(scene.cameras, frame_names(scene), strict=True), 1):
        lens = lenses.setdefault(_pinhole(camera), len(lenses) + 1)
        quat = rotations_to_quats(torch.from_numpy(camera.viewmat[:3, :3].copy())).numpy()
        pose = " ".join(repr(float(value)) for value in (*quat, *camera.viewmat[:3, 3]))
        images.append(f"{number} {pose} {lens} {name}\n\n")
    write_text(folder / "cameras.txt", "".join(f"{number} {lens}\n" for lens, number in lenses.items()))
    write_text(folder / "images.txt", "".join(images))
    chosen = slice(None, None, -(-len(points.means) // MAX_POINTS) or 1)
    means, colors = points.means[chosen].numpy(), np.rint(255 * points.colors[chosen].numpy()).astype(int)
    lines = [
        f"{k} {x:.6g} {y:.6g} {z:.6g} {r} {g} {b} 0\n"
        for k, ((x, y, z), (r, g, b)) in enumerate(zip(means.tolist(), colors.tolist(), strict=True), 1)
    ]
    write_text(folder / "points3D.txt", "".join(lines))


def _pinhole(camera: Camera) -> str:
    numbers = " ".join(repr(value) for value in camera.intrinsics.tolist())
    return f"PINHOLE {camera.width} {camera.height} {numbers}"


COLMAP = Exporter(write, estimate_bytes, "colmap", has_gaussians=False, reader="flowsplat.priors.given.colmap.read_colmap")
SENTENCE = "The cameras as a text model, and the background's centers as points."
EXPORTERS.add(Entry("colmap", "COLMAP", SENTENCE, COLMAP, place=80))
