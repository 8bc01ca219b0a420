"""``flowsplat prepare``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from flowsplat.cli.arguments import NO_PREFIX, Out, Preset, Source
from flowsplat.cli.command import Command
from flowsplat.common.progress import report
from flowsplat.pipeline.config import RunConfig


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command with these settings by default."""

    def prepare(input: Source, out: Out, preset: Preset = "default", config: Annotated[RunConfig, NO_PREFIX] = defaults) -> None:
        """Only prepare: frames, cameras, flow, masks, depth and tracks, in OUT/scene.

        Args:
            input: As for run.
            out: Folder of the run.
            preset: As for run.
            config: All settings.
        """
        from flowsplat import pipeline

        folder = pipeline.prepare(input, out, config)
        report(f"Prepared: {folder.scene_path}. Next: flowsplat train {out}")

    return prepare


COMMAND = Command(build, place=30)
