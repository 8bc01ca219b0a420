"""``flowsplat benchmark ablations``."""

from __future__ import annotations

from flowsplat.cli.arguments import Out
from flowsplat.cli.command import Command
from flowsplat_benchmarks.ablations import benchmark as ablating
from flowsplat_benchmarks.commands import WORK, Names, Numbers, Root, Work


def ablations(
    root: Root, out: Out, rows: Names = (), scenes: Names = ablating.SCENES, seeds: Numbers = ablating.SEEDS,
    iterations: int = ablating.ITERATIONS, again: bool = False, work: Work = WORK,
) -> None:  # fmt: skip
    """What every part of the method is worth: short trainings without it, beside the paper's three ablation tables.

    Scenes are prepared once, in OUT/scenes, and shared by all runs; each run is one process and one .json. The tables, with a
    verdict on every row (confirmed, contradicted, not separable, no difference or one run), are in OUT/ablations.md and
    OUT/ablations.html. The same command again continues where it was stopped.

    Args:
        root: Folder with davis/<clip>/images and masks, and rig/<scene>.
        out: Folder for everything that comes out.
        rows: Names of rows, or of whole tables (representation, training, orders, ours, baselines); the default is all of them.
        scenes: Names of the scenes. Clips are brought to 427 pixels of width and have given masks; rendered scenes keep their
            size and have true priors.
        seeds: Every row is trained once with each.
        iterations: Frame-steps of every run.
        again: Train and measure again what is in OUT already; prepared scenes stay. Leave it out to go on from where that was
            stopped.
        work: How the benchmark is done.
    """
    ablating.run_ablations(root, out, rows, scenes, seeds, iterations, again, work)


COMMAND = Command(lambda _: ablations, place=50)
