"""The clip's cameras as nerfstudio's ``transforms.json``, with times from 0 to 1, OpenGL axes."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from flowsplat.common.files import write_json
from flowsplat.common.registry import Entry
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry.cameras import OPENGL
from flowsplat.output.export.cameras import frame_names
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.options import ExportOptions
from flowsplat.scenes import Scene


def write(folder: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """Write ``transforms.json`` into the folder."""
    at = Path(os.path.relpath(scene.folder.resolve(), folder.resolve()))
    frames = []
    for camera, name, time in zip(scene.cameras, frame_names(scene), scene.times.tolist(), strict=True):
        K = camera.K
        frames.append({
            "file_path": (at / name).as_posix(), "time": time, "w": camera.width, "h": camera.height, "fl_x": K[0, 0],
            "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "transform_matrix": np.linalg.inv(camera.viewmat) @ OPENGL,
        })  # fmt: skip
    write_json(folder / "transforms.json", {"camera_model": "OPENCV", "frames": frames})


def estimate_bytes(model: SceneModel, scene: Scene, options: ExportOptions) -> int:
    """Return about how many it will be."""
    return 700 * scene.num_frames


NERFSTUDIO = Exporter(
    write, estimate_bytes, "nerfstudio", has_gaussians=False, reader="flowsplat.output.camera_files.read_camera_file"
)
EXPORTERS.add(Entry("nerfstudio", "Nerfstudio", "The cameras with times, as transforms.json.", NERFSTUDIO, place=90))
