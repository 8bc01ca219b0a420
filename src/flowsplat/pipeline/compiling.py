"""Kernels are compiled by a process of their own while a first run is at work.

What is compiled is kept on disk, where the run then finds it. Once the kernels of this code are compiled there is no such
process.
"""

from __future__ import annotations

import contextlib
import gc
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numba
from numba.core.sigutils import normalize_signature

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_json
from flowsplat.common.kernel_cache import kernels_folder
from flowsplat.common.process_control import give_way
from flowsplat.common.progress import spinner
from flowsplat.common.source import PACKAGE, source_state
from flowsplat.common.threads import core_left_to
from flowsplat.common.user_cache import cache_folder

SIGNATURES = Path(__file__).with_name("signatures.json")
NICENESS = 10
"""By how much the process gives way to the run. Chosen by eye."""
_COMMAND = "import sys; sys.path[:] = [path for path in sys.path if path]; from flowsplat.pipeline.compiling import main; main()"
"""Without the folder that the process begins in, which Python would search first: what lies beside a clip must not run."""


def code_state(device: str) -> dict[str, Any]:
    """Return what compiled kernels belong to: the code, the compiler and the processor, and where they are kept."""
    return {
        "source": source_state(), "package": str(PACKAGE), "numba": numba.__version__, "cpu": numba.config.CPU_NAME or "native",
        "cache": str(kernels_folder()), "device": device,
    }  # fmt: skip


def is_noted(marker: Path, state: dict[str, Any]) -> bool:
    """Return whether a file says that the kernels of a state were compiled."""
    with contextlib.suppress(InputError):
        return bool(read_json(marker) == state)
    return False


def note(marker: Path, state: dict[str, Any]) -> None:
    """Write that they were; where that is impossible they are only compiled once more."""
    with contextlib.suppress(InputError):
        make_folder(marker.parent)
        write_json(marker, state)


class Ahead:
    """The process that compiles, if there is one."""

    def __init__(self, process: subprocess.Popen[bytes] | None):
        self._process = process

    @property
    def compiled(self) -> bool:
        """Whether there was such a process."""
        return self._process is not None

    @property
    def is_busy(self) -> bool:
        """Whether it compiles."""
        return self._process is not None and self._process.poll() is None

    def wait(self) -> None:
        """Wait until it has ended: it began earlier than whoever would compile the same now."""
        if self._process is not None and self.is_busy:
            with spinner("Compiling the kernels, once"):
                self._process.wait()

    def stop(self) -> None:
        """End it."""
        if self._process is not None and self.is_busy:
            self._process.terminate()
            self._process.wait()


def are_missing(device: str) -> bool:
    """Return whether kernels for this device are not compiled yet: ``cpu``, or another, for which nothing is compiled here."""
    return device == "cpu" and not is_noted(_marker(), code_state(device))


@contextlib.contextmanager
def compile_ahead(device: str) -> Iterator[Ahead]:
    """Let kernels be compiled beside what is done inside, where they are not compiled yet.

    Args:
        device: what will train: ``cpu``, or another, for which nothing is compiled here.
    """
    process = None
    if are_missing(device):
        with contextlib.suppress(OSError):  # then the run compiles
            quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            process = subprocess.Popen([sys.executable, "-c", _COMMAND], **quiet)  # type: ignore[call-overload]
    ahead = Ahead(process)
    try:
        with contextlib.nullcontext() if process is None else core_left_to(process):
            yield ahead
    finally:
        ahead.stop()


def _marker() -> Path:
    return cache_folder() / "compiled_kernels.json"


def read_signatures() -> list[tuple[str, str]]:
    """Return every kernel of a run with preset ``default`` and priors of its own, in the order in which it needs them.

    Returns:
        names (``splatting.cpu.tiles.prefix_sum``) and types of arguments in Numba's notation (``int64[::1], int64``).
        ``python -m flowsplat_benchmarks.scripts.compiling --write`` makes the list anew.
    """
    return [(name, types) for name, types in read_json(SIGNATURES, list[tuple[str, str]])]


def compile_kernel(name: str, arguments: str) -> None:
    """Compile one kernel for arguments of these types, unless it is kept on disk.

    Raises:
        Exception: there is no such kernel, or it takes other arguments.
    """
    module, _, function = name.rpartition(".")
    kernel = getattr(import_module(f"{PACKAGE.name}.{module}"), function)
    kernel.compile(normalize_signature(f"void({arguments})")[0])


def compile_kernels(part: slice = slice(None)) -> None:
    """Compile what ``read_signatures`` lists, or a part of it, one after the other."""
    # The compiler makes millions of small objects: looking among them for what nothing uses any more takes a twentieth of its time.
    collects = gc.isenabled()
    gc.disable()
    try:
        for name, arguments in read_signatures()[part]:
            with contextlib.suppress(Exception):  # The run compiles what it needs, and then says what is wrong.
                compile_kernel(name, arguments)
    finally:
        if collects:
            gc.enable()


def note_compiled() -> None:
    """Write that all kernels of the list are compiled."""
    note(_marker(), code_state("cpu"))


def main() -> None:
    """What the process does."""
    give_way(NICENESS)
    compile_kernels()
    note_compiled()
