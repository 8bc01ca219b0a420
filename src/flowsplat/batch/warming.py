"""The kernels, compiled once before many processes would each compile them."""

from __future__ import annotations

import contextlib
import tempfile
import threading
from dataclasses import replace
from pathlib import Path

import numba

from flowsplat.batch.embedded import Embedded
from flowsplat.batch.work import Attempt, Job
from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json, write_json
from flowsplat.common.progress import busy, say
from flowsplat.common.source import PACKAGE, source_state
from flowsplat.output.videos import RenderOptions
from flowsplat.pipeline import run
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.speed import cache_file
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic_video

SPEC = SyntheticScene(width=96, height=64, frames=12)
ITERATIONS = 12


def compile_kernels(device: str) -> None:
    """Run a tiny clip, once for every state of the code on a machine: Numba keeps what it compiles beside the code.

    Where that does not work it is said, and the clips compile what they need.
    """
    marker = cache_file().with_name("compiled.json")
    state = {
        "source": source_state(), "package": str(PACKAGE), "numba": numba.__version__, "cpu": numba.config.CPU_NAME or "native",
        "cache": numba.config.CACHE_DIR, "device": device,
    }  # fmt: skip
    with contextlib.suppress(InputError):
        if read_json(marker) == state:
            return
    with tempfile.TemporaryDirectory(prefix="flowsplat-") as folder, busy("Compiling the kernels, once"):
        engine = Embedded(Path(folder), 1)
        engine.start(Job("compile", "", _Tiny(device)), fewer=False)
        try:
            ended = next(iter(engine.wait(threading.TIMEOUT_MAX)))
        finally:
            engine.stop()
        if ended.outcome.how != "done":
            say(f"The kernels could not be compiled in advance: {ended.outcome.reason}.")
            return
    with contextlib.suppress(InputError):  # then the next batch tries again
        write_json(marker, state)


class _Tiny:
    """The run of a tiny clip."""

    def __init__(self, device: str):
        self._device = device

    def __call__(self, attempt: Attempt) -> dict[str, object]:
        config = RunConfig()
        train = replace(config.train, iterations=ITERATIONS, density=replace(config.train.density, every=4, start=4))
        config = replace(config, train=train, render=RenderOptions(paths=("input",)), device=self._device)  # type: ignore[arg-type]
        with tempfile.TemporaryDirectory(prefix="flowsplat-") as folder:
            write_synthetic_video(Path(folder) / "tiny.mp4", SPEC)
            run(Path(folder) / "tiny.mp4", Path(folder) / "run", config)
        return {}
