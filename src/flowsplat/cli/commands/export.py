"""``flowsplat export``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from flowsplat.cli.arguments import NO_PREFIX, Run, Target
from flowsplat.cli.command import Command
from flowsplat.common.progress import report
from flowsplat.common.registry import Entry
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.options import ExportOptions
from flowsplat.pipeline.config import RunConfig


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command, whose help says what formats there are."""

    def export(
        out: Run,
        to: Annotated[str, EXPORTERS.option()],
        path: Target = None,
        options: Annotated[ExportOptions, NO_PREFIX] = ExportOptions(),  # noqa: B008 (frozen)
    ) -> None:
        """A trained run in the format of other programs, or as a page that plays it: one .html, no network, no server.

        Args:
            out: Folder of the run. Of a clip with several shots html makes one page of all, which plays them one after the other.
            to: FORMATS
            path: File or folder to write; without it, in RUN/export.
            options: What and how.
        """
        from flowsplat import pipeline
        from flowsplat.output.export import export_scene
        from flowsplat.pipeline.shot_list import read_shots
        from flowsplat.scenes import Scene

        listed = read_shots(out)
        if to == "html" and listed is not None and len(listed.shots) > 1:
            report(f"Written: {pipeline.export_shots(out, path, options)}")
            return
        out = pipeline.resolve_run(out)
        one_color = pipeline.one_color_of(out)
        report(f"Written: {export_scene(pipeline.load(out), Scene(out / 'scene'), to, path, options, one_color)}")

    assert export.__doc__ is not None
    export.__doc__ = export.__doc__.replace("FORMATS", " ".join(map(_describe, EXPORTERS.entries())))
    return export


def _describe(entry: Entry[Exporter]) -> str:
    """Say what a format is, and which options are for it that are not for all."""
    value = entry.value
    options = {
        "--time": value.is_of_one_time, "--flip-axes": value.can_flip_axes, "--embed": value.embed is not None,
        "--no-sound": value.holds_sound,
    }  # fmt: skip
    taken = ", ".join(option for option, is_taken in options.items() if is_taken)
    return f"{entry.name}: {entry.sentence.rstrip('.')}{f' ({taken})' if taken else ''}."


COMMAND = Command(build, place=110)
