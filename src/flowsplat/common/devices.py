"""Detect which backends work on this machine, and why the others do not; and whose kernels compute with a tensor."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from flowsplat.common.errors import InputError
from flowsplat.common.triton import triton_works

DeviceName = Literal["auto", "cpu", "cuda"]
Kernels = Literal["cpu", "triton", "reference"]


@dataclass(frozen=True)
class Backend:
    """One way to splat, whether it works here, and the reason."""

    name: str
    works: bool
    reason: str


def gpu_problem() -> str | None:
    """Why nothing can be computed on a GPU here; None where a small kernel ran on it. Tried once."""
    return triton_works()


def backends() -> list[Backend]:
    """Return what this machine can splat with."""
    from numba import config

    problem = gpu_problem()
    gpu = f"Triton on {torch.cuda.get_device_name()}" if problem is None else problem
    return [
        Backend("cpu", True, f"Numba on {os.cpu_count()} cores, {platform.machine()}, {config.CPU_NAME or 'native'}"),
        Backend("cuda", problem is None, gpu),
    ]


def pick_device(name: str) -> torch.device:
    """``auto`` is the GPU where it works; where not, one line says why, once, and it is the CPU.

    Raises:
        InputError: the device that was asked for does not work here.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise InputError(f"Unknown device {name!r}: use auto, cpu or cuda.")
    if name == "cpu":
        return torch.device("cpu")
    problem = gpu_problem()
    if problem is None:
        return torch.device("cuda")
    if name == "cuda":
        raise InputError(f"--device cuda does not work here: {problem}. Use --device cpu.")
    from flowsplat.common.progress import report_once  # which a rasterizer alone does not need

    report_once(f"Computing on the CPU: {problem}.")
    return torch.device("cpu")


def kernels_for(value: Tensor) -> Kernels:
    """Return whose kernels compute with tensors like this one; what is not float32 goes through the oracles, on any device."""
    return "reference" if value.dtype != torch.float32 else kernels_on(value.device)


def kernels_on(device: torch.device) -> Kernels:
    """Return whose kernels compute on a device."""
    if device.type == "cpu":
        return "cpu"
    return "triton" if device.type == "cuda" and gpu_problem() is None else "reference"


class Later:
    """Whole numbers [K] of a device that the host asks for now and reads later, when the device has other work."""

    def __init__(self, numbers: Tensor) -> None:
        self._numbers, self._arrived = numbers, None
        if numbers.is_cuda:
            self._numbers = torch.empty(numbers.shape, dtype=numbers.dtype, pin_memory=True)
            self._numbers.copy_(numbers, non_blocking=True)
            self._arrived = torch.cuda.Event()
            self._arrived.record(torch.cuda.current_stream(numbers.device))

    def values(self) -> list[int]:
        """Return the numbers. Waits for what the device was told before it was asked, and for nothing after that."""
        if self._arrived is not None:
            self._arrived.synchronize()
            self._arrived = None
        numbers: list[int] = self._numbers.tolist()
        return numbers


def upload(values: np.ndarray | Tensor, device: torch.device) -> Tensor:
    """Return a host array on a device, without waiting for what that device still computes; on the CPU the same memory."""
    tensor = values if isinstance(values, Tensor) else torch.from_numpy(np.ascontiguousarray(values))
    return tensor if tensor.device == device else tensor.to(device, non_blocking=True)
