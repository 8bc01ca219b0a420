"""Kernels of training and rendering are compiled by a process of their own while the priors of a first run are computed.

What is compiled is kept on disk, where the run then finds it. Once the kernels of this code are compiled there is no such
process.
"""

from __future__ import annotations

import contextlib
import gc
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder, read_json, write_json
from flowsplat.common.kernel_cache import kernels_folder
from flowsplat.common.progress import busy
from flowsplat.common.source import PACKAGE, source_state
from flowsplat.evaluation.poses import refine_camera
from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.observations import Observation, Observations
from flowsplat.geometry import Camera, Similarity
from flowsplat.pipeline.speed import cache_file
from flowsplat.scenes import Flow
from flowsplat.training.config import PRESETS
from flowsplat.training.trainer import Trainer

NICE = 10
"""By how much the process gives way to the run."""
_SIZE = 96, 72
_COMMAND = "import sys; sys.path[:] = [path for path in sys.path if path]; from flowsplat.pipeline.compiling import main; main()"
"""Without the folder that the process begins in, which Python would search first: what lies beside a clip must not run."""


def code_state(device: str) -> dict[str, Any]:
    """What compiled kernels belong to: the code, the compiler and the processor, and where they are kept."""
    return {
        "source": source_state(), "package": str(PACKAGE), "numba": numba.__version__, "cpu": numba.config.CPU_NAME or "native",
        "cache": str(kernels_folder()), "device": device,
    }  # fmt: skip


def is_noted(marker: Path, state: dict[str, Any]) -> bool:
    """Whether a file says that the kernels of a state were compiled."""
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
    def is_busy(self) -> bool:
        """Whether it compiles."""
        return self._process is not None and self._process.poll() is None

    def wait(self) -> None:
        """Wait until it has ended: it began earlier than whoever would compile the same now."""
        if self._process is not None and self.is_busy:
            with busy("Compiling the kernels, once"):
                self._process.wait()

    def stop(self) -> None:
        """End it."""
        if self._process is not None and self.is_busy:
            self._process.terminate()
            self._process.wait()


@contextlib.contextmanager
def compiling_ahead(device: str) -> Iterator[Ahead]:
    """Let kernels be compiled beside what is done inside, where they are not compiled yet.

    Args:
        device: what will train: ``cpu``, or another, for which nothing is compiled here.
    """
    process = None
    if device == "cpu" and not is_noted(_marker(), code_state(device)):
        with contextlib.suppress(OSError):  # then the run compiles
            quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            process = subprocess.Popen([sys.executable, "-c", _COMMAND], **quiet)  # type: ignore[call-overload]
    ahead = Ahead(process)
    try:
        yield ahead
    finally:
        ahead.stop()


def _marker() -> Path:
    return cache_file().with_name("compiled_training.json")


def compile_training() -> None:
    """Train, render and refine a pose on a handful of Gaussians: every kernel of preset ``default`` runs."""
    gaussians, observations = _handful()
    config = replace(PRESETS["default"], iterations=len(observations), preview_every=0)
    trained = Trainer(observations, None, config, start=gaussians).run()
    model = SceneModel(trained, Similarity(), 0.0, 1.0)
    first, last = observations[0], observations[len(observations) - 1]
    model.render(first.camera, 0.0, (last.camera, 1.0))
    refine_camera(model, first.camera, 0.5, first.image / np.float32(255))


def _handful(count: int = 200) -> tuple[Gaussians4D, Observations]:
    """Gaussians before a camera, half of them moving, and two frames of noise."""
    model, (width, height) = PRESETS["default"].model, _SIZE
    generator = torch.Generator().manual_seed(0)
    params = {name: torch.zeros(count, *shape) for name, shape in parameter_shapes(model).items()}
    params["means"] = torch.rand(count, 3, generator=generator) - 0.5
    params["log_scales"].fill_(-3.0)
    params["quats"][:, 0] = 1
    gaussians = Gaussians4D(params, torch.arange(count) >= count // 2, model, model.sh_degree)
    viewmat = np.eye(4)
    viewmat[2, 3] = 1
    camera = Camera(viewmat, np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]), width, height)
    everywhere, flat = np.ones((height, width), bool), np.ones((height, width), np.float32)
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    flow, nothing = Flow(0, 1, np.zeros((height, width, 2), np.float32), flat), np.zeros((height, width), np.uint8)
    frames = [Observation(k, float(k), camera, image, flat, everywhere, nothing, flow if k == 0 else None, None) for k in range(2)]
    return gaussians, Observations(frames, Similarity())


def main() -> None:
    """What the process does."""
    with contextlib.suppress(AttributeError, OSError):  # not on Windows
        os.nice(NICE)
    # The compiler makes millions of small objects: looking among them for what nothing uses any more takes a twentieth of its time.
    gc.disable()
    compile_training()
    note(_marker(), code_state("cpu"))
