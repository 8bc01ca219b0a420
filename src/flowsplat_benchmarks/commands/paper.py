"""``flowsplat benchmark paper``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from flowsplat.cli.arguments import Out
from flowsplat.cli.command import Command
from flowsplat_benchmarks import paper as comparing

Results = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS [...]")]


def paper(results: Results, out: Out) -> None:
    """The tables of the paper beside ours, row by row; nothing is run.

    What benchmark davis, nvidia, ablations, models and fields left is put beside what is published, in OUT/paper.md and
    OUT/paper.html, with what differs; what is not there is called not measured.

    Args:
        results: Folders in which these benchmarks left their results (their OUT).
        out: Folder for the page.
    """
    comparing.write_paper(results, out)


COMMAND = Command(lambda _: paper, place=65)
