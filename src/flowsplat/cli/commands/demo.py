"""``flowsplat demo``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from flowsplat.cli.arguments import Out
from flowsplat.cli.command import Command


def demo(out: Out = Path("out/demo"), size: int = 320, frames: int = 40, world: Literal["street", "floating"] = "street") -> None:
    """The main job on a drawn clip, with our own priors and with the true ones, side by side.

    Args:
        out: Folder for both runs.
        size: Width of the clip in pixels.
        frames: Number of frames.
        world: What is filmed. street: someone walks, a cart rolls, a ball bounces. floating: three things float in a room,
            whose distance no camera can tell; figures of earlier versions are of it.
    """
    from flowsplat.pipeline.demo import run_demo

    run_demo(out, size, frames, world)


COMMAND = Command(lambda _: demo, place=80)
