"""``flowsplat view``."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

from flowsplat.cli.arguments import NO_PREFIX, Run
from flowsplat.cli.command import Command
from flowsplat.output.viewer.options import ViewOptions


def view(out: Run, options: Annotated[ViewOptions, NO_PREFIX] = ViewOptions()) -> None:  # noqa: B008 (frozen)
    """Look at a run in the browser, also while it trains: any place, any time, color, flow and depth.

    Or at a file of static Gaussians of any program (.ply, .splat, .spz).

    Args:
        out: Folder of the run, or a file.
        options: How it is served.
    """
    from flowsplat.output.splat_files import is_splat_file
    from flowsplat.output.viewer.server import view as serve

    if not is_splat_file(out):
        serve(out, options)
        return
    from flowsplat.pipeline.splat_file import open_splat_file

    with tempfile.TemporaryDirectory(prefix="flowsplat-view-") as folder:
        open_splat_file(out, Path(folder), options.device)
        serve(Path(folder), options)


COMMAND = Command(lambda _: view, place=100)
