"""``flowsplat benchmark models``."""

from __future__ import annotations

from flowsplat.cli.arguments import Out
from flowsplat.cli.command import Command
from flowsplat.common.devices import DeviceName
from flowsplat_benchmarks.commands import WORK, Names, Numbers, Root, Work
from flowsplat_benchmarks.models import benchmark as comparing


def models(
    root: Root, out: Out, models: Names = (), scenes: Names = comparing.SCENES, seeds: Numbers = comparing.SEEDS,
    iterations: int = comparing.ITERATIONS, device: DeviceName = "auto", base: bool = True, report_only: bool = False,
    again: bool = False, work: Work = WORK,
) -> None:  # fmt: skip
    """Motion models of several papers on the same clips: same start, priors, losses, steps and seeds; only the motion differs.

    Held out are times in gaps of 1, 3 and 5 frames and at the end of the clip, and of rendered scenes the cameras from aside.
    Scenes are prepared once, in OUT/scenes; each run is one process and one .json. The tables, with a verdict on every model, are
    in OUT/models.md and OUT/models.html. The same command again continues where it was stopped.

    Args:
        root: Folder with davis/<clip>/images and masks, and rig/<scene>.
        out: Folder for everything that comes out.
        models: Names of the models; the default is all of them.
        scenes: Names of the scenes. Clips are brought to 427 pixels of width and have given masks; rendered scenes keep their
            size and have true priors, or our own with -own behind the name (street-own).
        seeds: Every model is trained once with each.
        iterations: Frame-steps of every run.
        device: What to compute on.
        base: Also run the series, which the others are compared with. Without it, one model, one scene and one seed are one run:
            any number of such commands may be at work on one OUT, and the page shows what is there.
        report_only: Run nothing, and write the tables of what is in OUT.
        again: Train and measure again what is in OUT already; prepared scenes stay. Leave it out to go on from where that was
            stopped.
        work: How the benchmark is done.
    """
    comparing.run_models(root, out, models, scenes, seeds, iterations, again, work, device, base, report_only)


COMMAND = Command(lambda _: models, place=55)
