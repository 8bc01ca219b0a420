"""Cameras of nerfstudio's files: https://docs.nerf.studio/quickstart/data_conventions.html."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import OPENGL
from flowsplat.geometry.lens import Distortion

FISHEYE = "OPENCV_FISHEYE"
"""Name of the lens whose k1 to k4 belong to the angle; instant-ngp says ``is_fisheye`` instead."""
OTHER_MODELS = re.compile("fisheye|equirectangular|omnidirectional|vr180|orthophoto", re.IGNORECASE)
"""In the names of lenses that are neither pinholes nor as OpenCV has them (nerfstudio's ``cameras.py``)."""


def transforms_camera(where: Path | str, values: Mapping[str, Any], size: tuple[int, int]) -> tuple[Camera, Distortion]:
    """Return the camera of one frame of a ``transforms.json``, and how its lens bends its images.

    Args:
        where: what to call the file in an error.
        values: those of the file, and over them those of the frame, which may have a lens of its own.
        size: (width, height) in pixels where the file has none.

    Raises:
        InputError: the lens is of a kind that is not known here.
        KeyError, TypeError, ValueError, LinAlgError: a value is missing or cannot be used.
    """
    model = str(values.get("camera_model", ""))
    is_fisheye = model.upper() == FISHEYE or values.get("is_fisheye") is True
    if not is_fisheye and OTHER_MODELS.search(model):
        raise InputError(
            f"{where} describes a lens that is not known here, {model:.40}: undistort the images, and give the cameras of the "
            "undistorted ones."
        )
    width, height = image_size(values, ("w", "h"), size)
    if "fl_x" in values:
        fx = positive(values["fl_x"], "fl_x")
    else:
        fx = 0.5 * width / np.tan(0.5 * positive(values["camera_angle_x"], "camera_angle_x"))
    fy = positive(values.get("fl_y", fx), "fl_y")
    cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    names = ("k1", "k2", "k3", "k4") if is_fisheye else ("k1", "k2", "p1", "p2", "k3")
    distortion = Distortion(tuple(float(values.get(name, 0)) for name in names), is_fisheye)
    return Camera(from_opengl(values["transform_matrix"], "transform_matrix"), K, width, height), distortion


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
