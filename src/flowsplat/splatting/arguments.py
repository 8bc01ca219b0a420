"""Check the arguments of ``rasterize`` and ``rasterization``: converted to what they have to be, or refused in a sentence that
names the argument."""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
import torch
from torch import Tensor

Array = Tensor | np.ndarray


def to_tensors(**values: Array | None) -> dict[str, Any]:
    """Tensors of one float type on one device, by the names of the arguments; None stays None.

    NumPy arrays become what the tensors among the values are, and float32 on the CPU where there are none: that is what splatting
    computes in, while NumPy makes float64 of whatever one does not think of.

    Raises:
        ValueError: a value is neither a tensor nor an array of numbers, or two tensors differ in type or device.
    """
    tensors = {name: value for name, value in values.items() if isinstance(value, Tensor)}
    first, like = next(iter(tensors.items()), ("", torch.zeros(0)))
    for name, value in tensors.items():
        if not value.dtype.is_floating_point:
            raise ValueError(f"{name} must be of a float type, not {str(value.dtype)[6:]}")
        if value.dtype != like.dtype:
            raise ValueError(f"{name} is {str(value.dtype)[6:]}, {first} {str(like.dtype)[6:]}: give all in one float type")
        if value.device != like.device:
            raise ValueError(f"{name} is on {value.device}, {first} on {like.device}: give all on one device")
    return {
        name: value if value is None or isinstance(value, Tensor) else _to_tensor(name, value, like)
        for name, value in values.items()
    }


def _to_tensor(name: str, value: Any, like: Tensor) -> Tensor:
    try:
        array = np.asarray(value)
    except ValueError:  # lists of lists of different lengths
        array = np.empty(0, object)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be a tensor or an array of numbers, not {type(value).__name__}")
    return torch.tensor(array.astype(np.float64), dtype=like.dtype, device=like.device)


def to_pixels(name: str, value: Any) -> int:
    """Return a number of pixels, given as anything that is a whole number, a tensor [] too, as Python's own.

    Raises:
        ValueError: it is none.
    """
    try:
        pixels = operator.index(value)
    except (TypeError, ValueError):  # a tensor of several numbers is no index, either
        pixels = 0
    if pixels < 1:
        raise ValueError(f"{name} must be a whole number of pixels from 1 on, not {value!r:.40}")
    return pixels


def check_numbers(**values: Any) -> None:
    """Raise a ValueError that names the first value that is no number."""
    for name, value in values.items():
        try:
            is_number = not math.isnan(float(value))
        except (TypeError, ValueError):
            is_number = False
        if not is_number:
            raise ValueError(f"{name} must be a number, not {value!r:.40}")
