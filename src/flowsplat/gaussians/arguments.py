"""Check the arguments of ``render``: converted to what they have to be, or refused in a sentence that names the argument."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from torch import Tensor

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera

TIME_SLACK = 1e-3
"""Of the clip's length: what a time may lie outside of it, so that seconds that were rounded are still within. Chosen by eye."""


def to_number(value: Any, name: str) -> float:
    """Return a number as a float: any of Python, NumPy or torch, and arrays and tensors of one element.

    Raises:
        InputError: it is none, or not finite.
    """
    array = value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)
    if array.size != 1 or array.dtype.kind not in "fiu":
        raise InputError(f"{name} must be one number, not {_describe(value)}.")
    number = float(array.reshape(()))
    if not math.isfinite(number):
        raise InputError(f"{name} must be finite, not {number}.")
    return number


def check_time(value: Any, first: float, last: float, name: str = "t", unit: str = "s") -> float:
    """Return a time of a clip as a float.

    Args:
        first: time of the first frame.
        last: time of the last frame.
        name: what the argument is called.
        unit: what the times are in.

    Raises:
        InputError: it is no number, or outside the clip.
    """
    t = to_number(value, name)
    slack = TIME_SLACK * (last - first)
    if not first - slack <= t <= last + slack:
        raise InputError(f"{name} is {t:g}{unit and ' '}{unit}, outside the clip ({first:g} to {last:g}{unit and ' '}{unit}).")
    return t


def check_camera(value: Any, name: str = "camera") -> Camera:
    """Return a camera that can look at something.

    Raises:
        InputError: it is none, or its numbers are not finite, its rotation is none, or its image has no pixels.
    """
    if not isinstance(value, Camera):
        raise InputError(f"{name} must be a flowsplat.Camera, not {_describe(value)}.")
    if not value.is_valid:
        raise InputError(
            f"{name} is none that can look: viewmat [4, 4] must be finite, with a rotation in its first three rows and columns, "
            "K [3, 3] finite with focal lengths above 0, and width and height at least 1."
        )
    return value


def check_target(value: Any, first: float, last: float, unit: str = "s") -> tuple[Camera, float] | None:
    """Return what ``flow_to`` names: the other camera and its time, or None.

    Raises:
        InputError: it is not a pair of them.
    """
    if value is None:
        return None
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise InputError(f"flow_to must be a pair (camera, t), not {_describe(value)}.")
    return check_camera(value[0], "the camera of flow_to"), check_time(value[1], first, last, "the time of flow_to", unit)


def _describe(value: Any) -> str:
    shape = getattr(value, "shape", None)
    return f"{type(value).__name__} {value!r:.40}" if shape is None else f"{type(value).__name__} of shape {list(shape)}"
