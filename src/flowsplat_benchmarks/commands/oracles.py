"""``flowsplat benchmark oracles``."""

from __future__ import annotations

from collections.abc import Callable

from flowsplat.cli.arguments import Out, Preset
from flowsplat.cli.command import Command
from flowsplat.common.devices import DeviceName
from flowsplat.pipeline.config import RunConfig
from flowsplat.training.config import TrainConfig
from flowsplat_benchmarks.commands import WORK, Names, Root, Work, with_training


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command with these settings by default."""

    def oracles(
        root: Root, out: Out, scenes: Names = (), oracles: Names = (), preset: Preset = "default",
        train: TrainConfig = defaults.train, device: DeviceName = "auto", again: bool = False, quick: bool = False,
        work: Work = WORK,
    ) -> None:  # fmt: skip
        """What every prior costs: rendered scenes trained with one prior after the other replaced by the truth.

        A scene is prepared once with own priors, in OUT/scenes/<scene>. Each oracle is a copy with true layers in place of its own,
        in OUT/scenes/<scene>_<oracle>, and an ordinary run on it, in OUT/<scene>_<oracle>_...; its figures are in a .json in OUT,
        the tables in OUT/oracles.md and OUT/oracles.html. The same command again continues where it was stopped. With --quick
        nothing is trained: how far off the distance of every object is, in OUT/oracles_quick.md and OUT/oracles_quick.html.

        Args:
            root: Folder with rig/<scene>.
            out: Folder for everything that comes out.
            scenes: Names of the scenes to run; the default is all of them. With --quick also random worlds: any-3, crowd-3 and
                dancers-3 are those of seed 3.
            oracles: Which: own (nothing is true), constant, depth trajectory, shape offset (of the depth of objects), outline (true
                masks, too), background (its depth, too), flow (too), cameras (all is true). Each holds what is true in those before
                it. And of masks alone, from own priors on, with depth of our own: ids (true numbers), shadow (what rests is in no
                mask), parts (what was found is whole), masks (all true). The default is all of them, with --quick own and those of
                masks.
            preset: How they are trained: fast, default, paper or high. Frames and their size are the protocol's.
            train: Settings of training that differ from the preset's; the tables name them.
            device: What to compute on.
            quick: Measure distances alone, without training.
            again: Forget oracle scenes, runs and figures that are in OUT of these; prepared scenes stay. Leave it out to go on from
                where that was stopped.
            work: How the benchmark is done.
        """
        from flowsplat_benchmarks.oracles import run_oracles, run_quick_oracles

        config = with_training(defaults, train, device)
        if quick:
            run_quick_oracles(root, out, scenes, oracles, config, again, work)
        else:
            run_oracles(root, out, scenes, oracles, preset, config, again, work)

    return oracles


COMMAND = Command(build, place=70)
