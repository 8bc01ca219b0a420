"""``flowsplat benchmark``."""

from __future__ import annotations

from flowsplat.cli.command import Command


def benchmark() -> None:
    """Whole benchmarks over many scenes, to tables: flowsplat benchmark --help lists them."""


COMMAND = Command(lambda _: benchmark, place=90)
