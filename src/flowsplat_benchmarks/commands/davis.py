"""``flowsplat benchmark davis``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from flowsplat.cli.arguments import Out, Preset
from flowsplat.cli.command import Command
from flowsplat.common.devices import DeviceName
from flowsplat.pipeline.config import RunConfig
from flowsplat.training.config import TrainConfig
from flowsplat_benchmarks.commands import WORK, Names, Root, Work, with_training


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command with these settings by default."""

    def davis(
        root: Root, out: Out, scenes: Names = (), masks: Literal["given", "own"] = "given", preset: Preset = "default",
        train: TrainConfig = defaults.train, device: DeviceName = "auto", again: bool = False, work: Work = WORK,
    ) -> None:  # fmt: skip
        """Whole runs on clips of DAVIS: every tenth frame is predicted; beside the paper's figures.

        Every clip is an ordinary run in OUT/<clip>_...; its figures are in the .json beside it, the tables in OUT/davis.md, with
        images in OUT/davis.html. The same command again continues where it was stopped.

        Args:
            root: Folder with davis/<clip>/images and masks, or with DAVIS itself (JPEGImages/480p, Annotations/480p).
            out: Folder for everything that comes out.
            scenes: Names of the clips to run; the default is all of them.
            masks: given (those of the data set, for training frames) or own (found by us; the given ones only measure).
            preset: How it is trained: fast, default, paper or high. Frames, their size and the split are the protocol's.
            train: Settings of training that differ from the preset's; the tables name them.
            device: What to compute on.
            again: Forget what is in OUT of these clips; leave it out to go on from where that was stopped.
            work: How the benchmark is done.
        """
        from flowsplat_benchmarks.datasets import davis_cases, run_benchmark

        run_benchmark("davis", davis_cases(root, scenes, masks, preset, with_training(defaults, train, device)), out, again, work)

    return davis


COMMAND = Command(build, place=20)
