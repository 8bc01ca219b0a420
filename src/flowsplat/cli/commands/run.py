"""``flowsplat run``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from flowsplat.cli.arguments import NO_PREFIX, Out, Preset, Source
from flowsplat.cli.command import Command
from flowsplat.cli.runs import print_figures
from flowsplat.pipeline.config import RunConfig


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command with these settings by default."""

    def run(input: Source, out: Out, preset: Preset = "default", config: Annotated[RunConfig, NO_PREFIX] = defaults) -> None:
        """A clip becomes a 4D scene: prepare, train, evaluate and render.

        The same command again continues where it was stopped.

        Args:
            input: A video file, a folder of images, a folder with images/ and masks/, a DAVIS root (with --sequence), a
                rig scene, an NVIDIA Dynamic Scene, or a prepared scene.
            out: Folder for everything that comes out.
            preset: fast (half size, about two minutes), default, paper (the paper's settings) or high (ten times default).
            config: All settings.
        """
        from flowsplat import pipeline

        print_figures(pipeline.run(input, out, config), out)

    return run


COMMAND = Command(build, place=10)
