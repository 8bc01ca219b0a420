"""The kernels of the card on a machine that has none, for rehearsals: in Triton's interpreter, on tensors of the CPU."""

from __future__ import annotations

from typing import Any, NoReturn

import torch

from flowsplat.common import devices
from flowsplat.common.triton import is_interpreted
from flowsplat.gaussians.culling import capacity
from flowsplat.splatting import api as splatting


def compute_with_triton() -> None:
    """From now on, and in this process, every operation on float32 is computed by the Triton kernels, on the CPU too."""
    if not is_interpreted():
        raise RuntimeError("set TRITON_INTERPRET=1 before Triton is imported")
    capacity.GRANULE = 8  # the interpreter takes its time with padding, too
    pick: Any = splatting._pick
    devices.kernels_for = lambda value: "triton" if value.dtype == torch.float32 else "reference"
    splatting._pick = lambda backend, means: "triton" if backend == "auto" else pick(backend, means)


def break_blending() -> None:
    """From now on the kernel that blends cannot be launched, as where a compiler fails."""
    from flowsplat.splatting.triton import blending

    class Broken:
        def __getitem__(self, grid: object) -> NoReturn:
            raise RuntimeError("the kernel that blends is broken on purpose")

    blending.blend_forward = Broken()


def pytest_configure() -> None:
    """As a plugin of pytest, with ``-p flowsplat_benchmarks.scripts.gpu_parts.interpreted``: tests with the broken kernel."""
    break_blending()
