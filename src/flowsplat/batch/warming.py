"""The kernels, compiled once before many processes would each compile them."""

from __future__ import annotations

import tempfile
import threading
from dataclasses import replace
from pathlib import Path

from flowsplat.batch.embedded import Embedded
from flowsplat.batch.work import Attempt, Job
from flowsplat.common.progress import report, spinner
from flowsplat.output.videos import RenderOptions
from flowsplat.pipeline import run
from flowsplat.pipeline.compiling import code_state, is_noted, note
from flowsplat.pipeline.config import RunConfig
from flowsplat.pipeline.speed import cache_file
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic_video

SPEC = SyntheticScene(width=96, height=64, frames=12)
WARMING_ITERATIONS = 12
"""Training steps that warm up, with density control every fourth one."""


def compile_kernels(device: str) -> None:
    """Run a tiny clip, once for every state of the code on a machine: what is compiled is kept on disk.

    Where that does not work it is said, and the clips compile what they need.
    """
    marker, state = cache_file().with_name("compiled.json"), code_state(device)
    if is_noted(marker, state):
        return
    with tempfile.TemporaryDirectory(prefix="flowsplat-") as folder, spinner("Compiling the kernels, once"):
        engine = Embedded(Path(folder), 1)
        engine.start(Job("compile", "", _Tiny(device)), fewer=False)
        try:
            ended = next(iter(engine.wait(threading.TIMEOUT_MAX)))
        finally:
            engine.stop()
        if ended.outcome.how != "done":
            report(f"The kernels could not be compiled in advance: {ended.outcome.reason}.")
            return
    note(marker, state)


class _Tiny:
    """The run of a tiny clip."""

    def __init__(self, device: str):
        self._device = device

    def __call__(self, attempt: Attempt) -> dict[str, object]:
        config = RunConfig()
        train = replace(config.train, iterations=WARMING_ITERATIONS, density=replace(config.train.density, every=4, start=4))
        config = replace(config, train=train, render=RenderOptions(paths=("input",)), device=self._device)  # type: ignore[arg-type]
        with tempfile.TemporaryDirectory(prefix="flowsplat-") as folder:
            write_synthetic_video(Path(folder) / "tiny.mp4", SPEC)
            run(Path(folder) / "tiny.mp4", Path(folder) / "run", config)
        return {}
