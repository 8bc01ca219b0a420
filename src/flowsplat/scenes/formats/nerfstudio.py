"""Cameras of nerfstudio's files: https://docs.nerf.studio/quickstart/data_conventions.html."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import OPENGL
from flowsplat.scenes.formats.lens import require_pinhole


def transforms_camera(where: Path | str, values: Mapping[str, Any], size: tuple[int, int]) -> Camera:
    """Return the camera of one frame of a ``transforms.json``.

    Args:
        where: what to call the file in an error.
        values: those of the file, and over them those of the frame, which may have a lens of its own.
        size: (width, height) in pixels where the file has none.

    Raises:
        InputError: the lens is no pinhole.
        KeyError, TypeError, ValueError, LinAlgError: a value is missing or cannot be used.
    """
    if "fisheye" in str(values.get("camera_model", "")).lower():
        raise InputError(f"{where} describes a fisheye: undistort the images, and give the cameras of the undistorted ones.")
    width, height = image_size(values, ("w", "h"), size)
    if "fl_x" in values:
        fx = positive(values["fl_x"], "fl_x")
    else:
        fx = 0.5 * width / np.tan(0.5 * positive(values["camera_angle_x"], "camera_angle_x"))
    fy = positive(values.get("fl_y", fx), "fl_y")
    cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    distortion = [float(values.get(name, 0)) for name in ("k1", "k2", "p1", "p2", "k3")]
    require_pinhole(where, K, width, height, distortion, " (cv2.undistort)")
    return Camera(from_opengl(values["transform_matrix"], "transform_matrix"), K, width, height)


def from_opengl(value: Any, name: str) -> np.ndarray:
    """Convert to world to camera [4, 4] in OpenCV's axes from camera to world in OpenGL's: 4 or 3 rows of 4 numbers, or all in one
    list.

    Raises:
        ValueError, LinAlgError: it is no such matrix, or has no inverse.
    """
    matrix = np.array(value, np.float64)
    if matrix.size not in (12, 16):
        raise ValueError(f"{name} has {matrix.size} numbers instead of 4 x 4 or 3 x 4")
    return np.linalg.inv(np.append(matrix, [0, 0, 0, 1.0])[:16].reshape(4, 4) @ OPENGL)


def image_size(values: Mapping[str, Any], names: tuple[str, str], size: tuple[int, int]) -> tuple[int, int]:
    """Return (width, height) in pixels under these names, else those of ``size``.

    Raises:
        ValueError: one is not a positive number.
    """
    width, height = (round(positive(values.get(name, default), name)) for name, default in zip(names, size, strict=True))
    return width, height


def positive(value: Any, name: str) -> float:
    """Return a number above 0.

    Raises:
        ValueError: it is none.
    """
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError) as error:
        raise ValueError(f"{name} is not a number") from error
    if not (np.isfinite(number) and number > 0):
        raise ValueError(f"{name} is {number:g}, it must be positive")
    return number
