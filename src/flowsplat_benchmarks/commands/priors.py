"""``flowsplat benchmark priors``."""

from __future__ import annotations

from flowsplat.cli.arguments import Out
from flowsplat.cli.command import Command
from flowsplat_benchmarks.commands import WORK, Root, Work


def priors(root: Root, out: Out, scenes: tuple[str, ...] = (), again: bool = False, work: Work = WORK) -> None:
    """Cameras, flow, masks, depth and tracks of many scenes against the truth.

    Prepares every scene as flowsplat prepare does, in OUT/<scene>, and measures it: figures in OUT/<scene>.json, the table
    with targets in OUT/priors.md, with images in OUT/priors.html. The same command again continues where it was stopped;
    remove an OUT/<scene>.json to measure what is prepared once more.

    Args:
        root: Folder with rig/<scene> (rendered scenes), davis/<clip>/images and masks, and flow/<pair> (frame10.png,
            frame11.png and flow10.flo).
        out: Folder for everything that comes out.
        scenes: Names of the scenes to run; the default is all of them.
        again: Prepare and measure again what is there already; leave it out to go on from where that was stopped.
        work: How the benchmark is done.
    """
    from flowsplat_benchmarks.priors import run_priors_benchmark

    run_priors_benchmark(root, out, scenes, again, work)


COMMAND = Command(lambda _: priors, place=10)
