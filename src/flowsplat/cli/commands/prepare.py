"""``flowsplat prepare``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from flowsplat.cli.arguments import NO_PREFIX, OutOfClip, Preset, Source, choose_out
from flowsplat.cli.command import Command
from flowsplat.common.progress import report
from flowsplat.pipeline.config import RunConfig


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command with these settings by default."""

    def prepare(
        input: Source, out: OutOfClip = None, preset: Preset = "default", config: Annotated[RunConfig, NO_PREFIX] = defaults
    ) -> None:
        """Only prepare: frames, cameras, flow, masks, depth and tracks, in OUT/scene.

        Args:
            input: As for run.
            out: As for run.
            preset: As for run.
            config: All settings.
        """
        from flowsplat import pipeline

        out = out or choose_out(input, config.input.sequence)
        folder = pipeline.prepare(input, out, config)
        report(f"Prepared: {folder.scene_path}. Next: flowsplat train {out}")

    return prepare


COMMAND = Command(build, place=30)
