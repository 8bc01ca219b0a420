"""``flowsplat benchmark rig``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from flowsplat.cli.arguments import Out, Preset
from flowsplat.cli.command import Command
from flowsplat.common.devices import DeviceName
from flowsplat.pipeline.config import RunConfig
from flowsplat.training.config import TrainConfig
from flowsplat_benchmarks.commands import WORK, Names, Root, Work, with_training
from flowsplat_benchmarks.datasets.learned_like import StandIn

STAND_IN = StandIn()


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command with these settings by default."""

    def rig(
        root: Root, out: Out, scenes: Names = (), priors: Literal["true", "own", "learned-like"] = "own",
        stand_in: StandIn = STAND_IN, preset: Preset = "default", train: TrainConfig = defaults.train, device: DeviceName = "auto",
        again: bool = False, work: Work = WORK,
    ) -> None:  # fmt: skip
        """Whole runs on rendered scenes: held-out cameras, and the errors of flow, depth and tracks in 3D.

        Results as of benchmark davis, in OUT/rig.md and OUT/rig.html.

        Args:
            root: Folder with rig/<scene>.
            out: Folder for everything that comes out.
            scenes: Names of the scenes to run; the default is all of them.
            priors: own (from the images alone), true (cameras, depth, masks, flow and tracks of the renderer) or learned-like (own,
                with the help of true depth and masks made worse in known ways, as a network's are).
            stand_in: Of learned-like priors.
            preset: How it is trained: fast, default, paper or high. Frames and their size are the protocol's.
            train: Settings of training that differ from the preset's; the tables name them.
            device: What to compute on.
            again: Forget what is in OUT of these scenes; leave it out to go on from where that was stopped.
            work: How the benchmark is done.
        """
        from flowsplat_benchmarks.datasets import rig_cases, run_benchmark

        used = (stand_in, out / "learned_like") if priors == "learned-like" else None
        cases = rig_cases(root, scenes, priors, preset, with_training(defaults, train, device), used)
        run_benchmark("rig", cases, out, again, work)

    return rig


COMMAND = Command(build, place=30)
