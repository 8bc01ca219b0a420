"""``flowsplat run``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from flowsplat.cli.arguments import NO_PREFIX, OutOfClip, Preset, Source, choose_out
from flowsplat.cli.command import Command
from flowsplat.cli.runs import print_figures, print_shot_figures
from flowsplat.pipeline.config import RunConfig


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command with these settings by default."""

    def run(
        input: Source, out: OutOfClip = None, preset: Preset = "default", shots: Literal["split", "off"] = "split",
        config: Annotated[RunConfig, NO_PREFIX] = defaults,
    ) -> None:  # fmt: skip
        """A clip becomes a 4D scene: prepare, train, evaluate and render.

        The same command again continues where it was stopped.

        Args:
            input: A video file, a folder of images, a folder with images/ and masks/, a DAVIS root (with --sequence), a
                rig scene, an NVIDIA Dynamic Scene, or a prepared scene.
            out: Folder for everything that comes out; without it, out/NAME of the clip.
            preset: fast (half size, about two minutes), default, paper (the paper's settings) or high (ten times default).
            shots: Of a video or a folder of images with cuts, make a scene of each shot of ten frames and more (OUT/shots/01,
                02, ...), with one report; off: one scene of all. Given files are of one scene, too, and so are clicks unless they
                name a shot: x,y@shot/frame.
            config: All settings.
        """
        from flowsplat import pipeline

        out = out or choose_out(input, config.input.sequence)
        metrics = pipeline.run_shots(input, out, config, shots)
        if metrics is None:
            print_figures(pipeline.run(input, out, config), out)
        else:
            print_shot_figures(metrics, out)

    return run


COMMAND = Command(build, place=10)
