"""``flowsplat view``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from flowsplat.cli.arguments import NO_PREFIX, Run, Target
from flowsplat.cli.command import Command
from flowsplat.common.errors import InputError
from flowsplat.output.viewer.options import ViewOptions


def view(
    out: Run,
    options: Annotated[ViewOptions, NO_PREFIX] = ViewOptions(),  # noqa: B008 (frozen)
    path: Target = None,
) -> None:
    """Look at a run in the browser, also while it trains: any place, any time, color, flow and depth.

    Or at a file of static Gaussians of any program (.ply, .splat, .spz).

    Args:
        out: Folder of the run, or a file.
        options: How it is served.
        path: Folder for what is saved while looking at a file, empty or missing. None = out/ and the name of the file. A run has
            its own.
    """
    from flowsplat.output.splat_files import is_splat_file
    from flowsplat.output.viewer.server import check_serving
    from flowsplat.output.viewer.server import view as serve

    if not is_splat_file(out):
        if path is not None:
            raise InputError(f"{out} is a run, which keeps in {out}/viewer what is saved: leave out -o, which is for files.")
        from flowsplat.pipeline import resolve_run

        serve(resolve_run(out), options)
        return
    from flowsplat.pipeline.splat_file import open_splat_file

    check_serving(options)
    folder = path or Path("out") / out.stem
    open_splat_file(out, folder, options.device)
    serve(folder, options)


COMMAND = Command(lambda _: view, place=100)
