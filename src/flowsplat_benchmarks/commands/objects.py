"""``flowsplat benchmark objects``."""

from __future__ import annotations

from typing import Literal

from flowsplat.cli.arguments import Out
from flowsplat.cli.command import Command
from flowsplat_benchmarks.commands import WORK, Work


def objects(
    out: Out, worlds: int = 40, seed: int = 0, again: bool = False, kind: Literal["any", "dancers", "crowd"] = "any",
    work: Work = WORK,
) -> None:  # fmt: skip
    """How far away moving objects are estimated to be, in random worlds with exact truth.

    Every world is rendered and prepared once, in OUT/<seed>, with our own cameras, flow and masks and with true ones. The
    tables are in OUT/objects.md and OUT/objects.html, the figures in OUT/results.json. The same command again continues where
    it was stopped. Seeds below 900 are for tuning, 900 to 999 decide between versions and are never looked at one by one,
    1000 to 1199 are only reported.

    Args:
        out: Folder for everything that comes out.
        worlds: How many worlds.
        seed: That of the first one; the others follow.
        again: Place the objects anew in worlds that are prepared already: what to call after that step was changed.
        kind: Of the worlds: any, dancers alone, or a crowd, whose people, vehicles and animals pass one another in plain
            clothes. One OUT for each.
        work: How the benchmark is done.
    """
    from flowsplat_benchmarks.objects import run_objects_benchmark

    run_objects_benchmark(out, worlds, seed, again, options=work, kind=kind)


COMMAND = Command(lambda _: objects, place=80)
