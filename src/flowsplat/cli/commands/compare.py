"""``flowsplat compare``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from flowsplat.cli.arguments import Target
from flowsplat.cli.command import Command
from flowsplat.common.progress import report

Runs = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN RUN [RUN ...]")]


def compare(runs: Runs, path: Target = None) -> None:
    """Runs beside each other on one page: videos that play in step, figures, and the settings that differ.

    Args:
        runs: Folders of two measured runs or more.
        path: The page to write; without it, compare.html beside the first run.
    """
    from flowsplat.pipeline.compare import compare as write

    report(f"Written: {write(*runs, out=path)}")


COMMAND = Command(lambda _: compare, place=65)
