"""``flowsplat benchmark fields``."""

from __future__ import annotations

from flowsplat.cli.arguments import Out
from flowsplat.cli.command import Command
from flowsplat_benchmarks.commands import WORK, Names, Numbers, Root, Work
from flowsplat_benchmarks.fields import benchmark as training


def fields(
    root: Root, out: Out, fields: Names = (), scenes: Names = training.SCENES, times: Numbers = training.TIMES,
    seconds: float = 0.0, size: int = training.SIZE, seed: int = 0, again: bool = False, work: Work = WORK,
) -> None:  # fmt: skip
    """T-NeRF and HyperNeRF on the same clips, trained for as long as default takes, and for ten times as long.

    Default is trained first, which says how many seconds these are. Results as of benchmark ablations, in OUT/fields.md and
    OUT/fields.html. A training that is stopped is continued by the same command, and so is the rendering of held-out images, which
    takes minutes each.

    Args:
        root: Folder with davis/<clip>/images and masks, and rig/<scene>.
        out: Folder for everything that comes out.
        fields: Names of fields, t-nerf or hypernerf; the default is both.
        scenes: Names of the scenes.
        times: How many times the seconds of default each is trained, one run for each number.
        seconds: Seconds in the place of those of default, which is not trained then; 0 = those of default.
        size: Long side in pixels to which clips are brought, 0 = as they are; rendered scenes keep their size.
        seed: Of every random choice.
        again: Train and measure again what is in OUT already; prepared scenes stay. Leave it out to go on from where that was
            stopped.
        work: How the benchmark is done.
    """
    training.run_fields(root, out, fields, scenes, times, seconds, size, seed, again, work)


COMMAND = Command(lambda _: fields, place=65)
