"""``flowsplat export``."""

from __future__ import annotations

from typing import Annotated

from flowsplat.cli.arguments import NO_PREFIX, Run, Target
from flowsplat.cli.command import Command
from flowsplat.common.progress import report
from flowsplat.output.export.options import ExportOptions, Format


def export(
    out: Run,
    to: Format,
    path: Target = None,
    options: Annotated[ExportOptions, NO_PREFIX] = ExportOptions(),  # noqa: B008 (frozen)
) -> None:
    """A trained run in the format of other programs, or as a page that plays it: one .html, no network, no server.

    Args:
        out: Folder of the run.
        to: html (the player), ply (3DGS, at one time), ply-sequence (one ply a frame, as SuperSplat plays it), splat (32 bytes
            a Gaussian, at one time), spz (compressed, at one time), npz or safetensors (every parameter), colmap or
            nerfstudio (the cameras).
        path: File or folder to write; without it, in RUN/export.
        options: What and how.
    """
    from flowsplat import pipeline
    from flowsplat.output.export import export_scene
    from flowsplat.scenes import Scene

    report(f"Written: {export_scene(pipeline.load(out), Scene(out / 'scene'), to, path, options)}")


COMMAND = Command(lambda _: export, place=110)
