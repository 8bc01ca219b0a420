"""``flowsplat benchmark caps``."""

from __future__ import annotations

from flowsplat.cli.arguments import Out
from flowsplat.cli.command import Command
from flowsplat_benchmarks.ablations import caps as capping
from flowsplat_benchmarks.commands import WORK, Names, Numbers, Root, Work


def caps(
    root: Root, out: Out, scenes: Names = capping.SCENES, caps: Numbers = capping.CAPS, steps: Numbers = capping.STEPS,
    seeds: Numbers = capping.SEEDS, size: int = capping.CLIP_SIDE, again: bool = False, work: Work = WORK,
) -> None:  # fmt: skip
    """What more Gaussians and more frame-steps bring and cost: PSNR against Gaussians, bytes of the page, seconds of training,
    milliseconds an image, and steps.

    Results as of benchmark ablations, in OUT/caps.md and OUT/caps.html; each drawing is an .svg, too.

    Args:
        root: Folder with davis/<clip>/images and masks, and rig/<scene>.
        out: Folder for everything that comes out.
        scenes: Names of the scenes.
        caps: Numbers of Gaussians at most, each trained for as many frame-steps as default has; 0 = as many as that takes.
        steps: Numbers of frame-steps, each with 200,000 Gaussians.
        seeds: Every point is trained once with each.
        size: Long side in pixels to which clips are brought, 0 = as they are; rendered scenes keep their size.
        again: Train and measure again what is in OUT already; prepared scenes stay. Leave it out to go on from where that was
            stopped.
        work: How the benchmark is done.
    """
    capping.run_caps(root, out, scenes, caps, steps, seeds, size, again, work)


COMMAND = Command(lambda _: caps, place=60)
