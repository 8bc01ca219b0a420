"""nerfstudio's ``transforms.json``: https://docs.nerf.studio/quickstart/data_conventions.html."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.priors.given.fitting import require_frames
from flowsplat.priors.given.lens import require_pinhole
from flowsplat.scenes import Scene
from flowsplat.scenes.formats.images import natural_key

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's axes of a camera to those with y up and z backward, and back."""


def is_nerfstudio(content: Any) -> bool:
    """Whether JSON has nerfstudio's layout."""
    return isinstance(content, dict) and isinstance(content.get("frames"), list)


def read_nerfstudio(path: Path, content: dict[str, Any], scene: Scene) -> list[Camera]:
    """One camera a frame; in the order of their times where all have one, else in the natural order of their pictures.

    Raises:
        InputError: a value is missing, a lens is no pinhole, or there is not one frame for each of the clip.
    """
    frames = content["frames"]
    require_frames(path, len(frames), scene, "frames")
    try:
        if all("time" in frame for frame in frames):
            frames = sorted(frames, key=lambda frame: float(frame["time"]))
        else:
            frames = sorted(frames, key=lambda frame: natural_key(Path(frame["file_path"])))
        return [_camera(path, {**content, **frame}, scene) for frame in frames]
    except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as error:
        raise InputError(f"{path} is no transforms.json of nerfstudio: {_reason(error)}.") from error


def _reason(error: Exception) -> str:
    return f"it has no {error}" if isinstance(error, KeyError) else str(error)


def _camera(path: Path, values: dict[str, Any], scene: Scene) -> Camera:
    if "fisheye" in str(values.get("camera_model", "")).lower():
        raise InputError(f"{path} describes a fisheye: undistort the pictures first, and give the cameras of the undistorted ones.")
    width, height = int(values.get("w", scene.width)), int(values.get("h", scene.height))
    if "fl_x" in values:
        fx = float(values["fl_x"])
    else:
        fx = 0.5 * width / np.tan(0.5 * float(values["camera_angle_x"]))
    fy = float(values.get("fl_y", fx))
    cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    require_pinhole(path, K, width, height, [float(values.get(name, 0)) for name in ("k1", "k2", "p1", "p2", "k3")])
    matrix = np.array(values["transform_matrix"], np.float64)
    if matrix.size == 12:
        matrix = np.concatenate([matrix.reshape(3, 4), [[0, 0, 0, 1.0]]])
    return Camera(np.linalg.inv(matrix.reshape(4, 4) @ _OPENGL), K, width, height)
