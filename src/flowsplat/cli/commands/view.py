"""``flowsplat view``."""

from __future__ import annotations

from typing import Annotated

from flowsplat.cli.arguments import NO_PREFIX, Run
from flowsplat.cli.command import Command
from flowsplat.output.viewer.options import ViewOptions


def view(out: Run, options: Annotated[ViewOptions, NO_PREFIX] = ViewOptions()) -> None:  # noqa: B008 (frozen)
    """Look at a run in the browser, also while it trains: any place, any time, color, flow and depth.

    Args:
        out: Folder of the run.
        options: How it is served.
    """
    from flowsplat.output.viewer.server import view as serve

    serve(out, options)


COMMAND = Command(lambda _: view, place=100)
