"""Triton where it is there: imported when first needed, run by its interpreter where there is no GPU.

With ``TRITON_INTERPRET=1`` in the environment *before Triton is imported*, kernels run in NumPy on tensors of the CPU: slow,
but the same code, so that it can be tested anywhere. Loops whose bounds are read from memory are written with ``while``: the
interpreter of Triton 3.6 cannot make a ``range`` of them with NumPy 2.4. Constants come after tensors, ``x * CONSTANT``: the
other way round the interpreter of 3.7 makes a constant of the product.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import lru_cache
from types import ModuleType

import torch
from torch import Tensor

from flowsplat.common.errors import first_line

MISSING = "Triton is not installed (it comes with PyTorch for GPUs on Linux; elsewhere: pip install triton)"


def require_triton() -> ModuleType:
    """The module ``triton``.

    Raises:
        ValueError: it is not installed.
    """
    try:
        import triton
    except ImportError as error:
        raise ValueError(MISSING) from error
    module: ModuleType = triton
    return module


def is_interpreted() -> bool:
    """Whether kernels run in Triton's interpreter. False where there is no Triton.

    What counts is what Triton found when it was imported: its own library of functions is interpreted from then on, or never.
    """
    try:
        triton = require_triton()
    except ValueError:
        return False
    return type(triton.language.cdiv).__name__ == "InterpretedFunction"


def check_runs(tensor: Tensor) -> None:
    """Raise a ValueError where kernels cannot run on the device of this tensor."""
    require_triton()
    if tensor.device.type == "cpu" and not is_interpreted():
        raise ValueError(
            "Triton runs on a GPU; for tensors on the CPU set TRITON_INTERPRET=1 before Triton is imported (slow: for tests)"
        )


def device_of(tensor: Tensor) -> AbstractContextManager[None]:
    """A context in which the device of this tensor is the current one: that is where Triton launches, whatever it is given.

    A tensor on the CPU, with which the interpreter computes, changes nothing.
    """
    context: AbstractContextManager[None] = torch.cuda.device_of(tensor)
    return context


def rows_per_program(count: int) -> int:
    """Rows (Gaussians, say) for one program of an elementwise kernel: a power of two.

    An interpreted program is a slow loop of its own, so there are few of them, but more than one.
    """
    if not is_interpreted():
        return 128
    return max(16, 1 << max(count // 3, 1).bit_length())


def power_of_two(number: int) -> int:
    """The smallest power of two that is at least this; the length of a Triton tensor."""
    return 1 << max(number - 1, 0).bit_length()


@lru_cache(maxsize=1)
def triton_works() -> str | None:
    """Why Triton's kernels cannot be used on this machine's GPU, in one line; None where a small one ran and was right."""
    if not torch.cuda.is_available():
        built = torch.version.cuda or torch.version.hip
        return "PyTorch sees no GPU" if built else "this PyTorch is a CPU build"
    try:
        require_triton()
    except ValueError as error:
        return str(error)
    if is_interpreted():
        return "TRITON_INTERPRET is set: Triton would run its kernels on the CPU"
    try:
        from flowsplat.common.triton_probe import probe

        right = probe()
    except Exception as error:  # Compilers and drivers fail with errors of their own.
        return f"{torch.cuda.get_device_name()} is there, but Triton fails on it: {first_line(error)}"
    return None if right else f"{torch.cuda.get_device_name()} is there, but a Triton kernel gave a wrong result on it"
