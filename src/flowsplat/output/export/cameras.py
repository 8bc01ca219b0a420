"""The clip's cameras for other programs: a COLMAP text model, and nerfstudio's ``transforms.json``.

Both name the images where they lie in the run, held-out ones included: who trains on these has no strict figures.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch

from flowsplat.common.files import make_folder, write_json, write_text
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import OPENGL
from flowsplat.geometry.rotations import rotations_to_quats
from flowsplat.output.export.still import Still
from flowsplat.scenes import Scene

MAX_POINTS = 100_000
"""Points that are written, at most, evenly chosen. A round number."""


def frame_names(scene: Scene) -> list[str]:
    """Return the image of every frame, relative to the folder of the scene."""
    heldout = set(scene.heldout_frames)
    return [f"heldout/frames/{i:05d}.png" if i in heldout else f"frames/{i:05d}.png" for i in range(scene.num_frames)]


def write_colmap(folder: Path, scene: Scene, points: Still) -> None:
    """``cameras.txt``, ``images.txt`` and ``points3D.txt``; the image path is the folder of the scene.

    Args:
        folder: gets the three files.
        scene: with cameras.
        points: their centers and colors become points without tracks, to start a training from.

    Raises:
        InputError: the scene has no cameras, or the folder cannot be written.
    """
    make_folder(folder)
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


def write_nerfstudio(folder: Path, scene: Scene) -> None:
    """``transforms.json`` with times from 0 to 1, OpenGL axes.

    Raises:
        InputError: the scene has no cameras, or the folder cannot be written.
    """
    make_folder(folder)
    at = Path(os.path.relpath(scene.folder.resolve(), folder.resolve()))
    frames = []
    for camera, name, time in zip(scene.cameras, frame_names(scene), scene.times.tolist(), strict=True):
        K = camera.K
        frames.append({
            "file_path": (at / name).as_posix(), "time": time, "w": camera.width, "h": camera.height, "fl_x": K[0, 0],
            "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "transform_matrix": np.linalg.inv(camera.viewmat) @ OPENGL,
        })  # fmt: skip
    write_json(folder / "transforms.json", {"camera_model": "OPENCV", "frames": frames})


def _pinhole(camera: Camera) -> str:
    numbers = " ".join(repr(value) for value in camera.intrinsics.tolist())
    return f"PINHOLE {camera.width} {camera.height} {numbers}"
