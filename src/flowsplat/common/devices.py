"""Which backends work on this machine, and why the others do not."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass

import torch

from flowsplat.common.errors import InputError


@dataclass(frozen=True)
class Backend:
    """One way to splat, whether it works here, and the reason."""

    name: str
    works: bool
    reason: str


def backends() -> list[Backend]:
    """What this machine can splat with."""
    from numba import config

    found = [Backend("cpu", True, f"Numba on {os.cpu_count()} cores, {platform.machine()}, {config.CPU_NAME or 'native'}")]
    if torch.cuda.is_available():
        reason = f"{torch.cuda.get_device_name()} is there, but this version has no GPU kernels yet"
    elif torch.version.cuda is None:
        reason = "this PyTorch is a CPU build, and this version has no GPU kernels yet"
    else:
        reason = "PyTorch sees no GPU, and this version has no GPU kernels yet"
    found.append(Backend("cuda", False, reason))
    return found


def pick_device(name: str) -> torch.device:
    """``auto`` and ``cpu`` give the CPU; a device without a working backend is refused.

    Raises:
        InputError: the device does not work here.
    """
    if name in ("auto", "cpu"):
        return torch.device("cpu")
    for backend in backends():
        if backend.name == name:
            raise InputError(f"--device {name} does not work here: {backend.reason}. Use --device cpu.")
    raise InputError(f"Unknown device {name!r}: use auto, cpu or cuda.")
