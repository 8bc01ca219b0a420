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


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command with these settings by default."""

    def rig(
        root: Root, out: Out, scenes: Names = (), priors: Literal["true", "own"] = "own", preset: Preset = "default",
        train: TrainConfig = defaults.train, device: DeviceName = "auto", again: bool = False, work: Work = WORK,
    ) -> None:  # fmt: skip
        """Whole runs on rendered scenes: held-out cameras, and the errors of flow, depth and tracks in 3D.

        Results as of benchmark davis, in OUT/rig.md and OUT/rig.html.

        Args:
            root: Folder with rig/<scene>.
            out: Folder for everything that comes out.
            scenes: Names of the scenes to run; the default is all of them.
            priors: own (from the images alone) or true (cameras, depth, masks, flow and tracks of the renderer).
            preset: How it is trained: fast, default, paper or high. Frames and their size are the protocol's.
            train: Settings of training that differ from the preset's; the tables name them.
            device: What to compute on.
            again: Forget what is in OUT of these scenes; leave it out to go on from where that was stopped.
            work: How the benchmark is done.
        """
        from flowsplat_benchmarks.datasets import rig_cases, run_benchmark

        run_benchmark("rig", rig_cases(root, scenes, priors, preset, with_training(defaults, train, device)), out, again, work)

    return rig


COMMAND = Command(build, place=30)
