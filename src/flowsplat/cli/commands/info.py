"""``flowsplat info``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from flowsplat.cli.command import Command


def info(path: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")] = None, licenses: bool = False) -> None:
    """What is in a run or a scene; versions; which backends work here, and why the others do not.

    Args:
        path: Folder of a run or a scene; without it only versions and backends are shown.
        licenses: List the license of every package that is installed because flowsplat needs it, and nothing else.
    """
    if licenses:
        from flowsplat.common.licenses import list_licenses

        print(*(f"{each.name} {each.version}: {each.license}" for each in list_licenses()), sep="\n")
        return
    from flowsplat.pipeline.describe import describe

    print(*describe(path), sep="\n")


COMMAND = Command(lambda _: info, place=70)
