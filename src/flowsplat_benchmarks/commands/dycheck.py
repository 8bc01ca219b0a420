"""``flowsplat benchmark dycheck``."""

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

    def dycheck(
        root: Root, out: Out, scenes: Names = (), preset: Preset = "default", train: TrainConfig = defaults.train,
        device: DeviceName = "auto", again: bool = False, work: Work = WORK,
    ) -> None:  # fmt: skip
        """Whole runs under DyCheck's protocol: other cameras where the clip saw what they show (mPSNR, mSSIM), and PCK of points.

        Results as of benchmark davis, in OUT/dycheck.md and OUT/dycheck.html.

        Args:
            root: Folder with dycheck/<scene>, each with camera, rgb and splits, and with covisible and keypoint where it has them.
            out: Folder for everything that comes out.
            scenes: Names of the scenes to run; the default is all of them.
            preset: How it is trained: fast, default, paper or high. Frames and their size are the protocol's.
            train: Settings of training that differ from the preset's; the tables name them.
            device: What to compute on.
            again: Forget what is in OUT of these scenes; leave it out to go on from where that was stopped.
            work: How the benchmark is done.
        """
        from flowsplat_benchmarks.datasets import dycheck_cases, run_benchmark

        run_benchmark("dycheck", dycheck_cases(root, scenes, preset, with_training(defaults, train, device)), out, again, work)

    return dycheck


COMMAND = Command(build, place=45)
