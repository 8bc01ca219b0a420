"""A tiny clip with truth and a finished run of it, made once for all tests that look at one; what they change, they copy.

``tests/run.py`` makes both before the tests begin (``python -m tests.shared PART FOLDER``), and lets kernels be compiled.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

from flowsplat.output.videos import RenderOptions
from flowsplat.pipeline import run
from flowsplat.pipeline.compiling import compile_kernels, note_compiled
from flowsplat.pipeline.config import RunConfig
from flowsplat.scenes.synthetic import SyntheticScene, write_synthetic
from flowsplat_benchmarks.worlds import draw_world

SPEC = SyntheticScene(width=64, height=48, frames=12, fps=6.0)
SCENE, OUT = "scene", "out"
FOLDER = "FLOWSPLAT_TESTS_SHARED"
"""The variable of the environment that names the folder where it was made before."""


def small_config(**training) -> RunConfig:
    """Trains in seconds."""
    config = RunConfig()
    train = replace(config.train, iterations=30, checkpoint_every=10, preview_every=10, **training)
    train = replace(train, density=replace(train.density, every=8, start=8))
    return replace(
        config,
        priors=replace(config.priors, priors="true"),
        train=train,
        render=RenderOptions(paths=("input",), width=32),
    )


def make_scene(folder: Path) -> Path:
    """The clip."""
    write_synthetic(folder / SCENE, SPEC, holdout=10)
    return folder / SCENE


def make_finished(folder: Path, scene: Path) -> Path:
    """The folder of a whole run of ``small_config``."""
    run(scene, folder / OUT, small_config())
    return folder / OUT


def made_before(name: str) -> Path | None:
    """The clip or the run that ``tests/run.py`` made."""
    folder = os.environ.get(FOLDER)
    return Path(folder) / name if folder else None


def main(part: str, folder: Path) -> None:
    """Compile one half of the kernels, or the other and those that draw worlds; or make the clip and the run."""
    if part == "finished":
        note_compiled()
        make_finished(folder, make_scene(folder))
    elif part == "kernels":
        compile_kernels(slice(0, None, 2))
    else:
        compile_kernels(slice(1, None, 2))
        draw_world(0, 64, 48, 10).image(0)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
