"""``flowsplat studio``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from flowsplat.cli.arguments import NO_PREFIX
from flowsplat.cli.command import Command
from flowsplat.studio.options import StudioOptions


def studio(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")] = Path("out/studio"),
    options: Annotated[StudioOptions, NO_PREFIX] = StudioOptions(),  # noqa: B008 (frozen)
) -> None:
    """Make scenes without a terminal: drop a clip on a page, click on what moves, look, share.

    A run that was started on the page goes on when the page or the studio is closed. The page shows the command line of all that it
    does.

    Args:
        folder: Where clips and scenes are kept; the same one shows them again.
        options: How it is served.
    """
    from flowsplat.studio.server import serve

    serve(folder, options)


COMMAND = Command(lambda _: studio, place=95)
