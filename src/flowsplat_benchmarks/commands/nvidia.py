"""``flowsplat benchmark nvidia``."""

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

    def nvidia(
        root: Root, out: Out, scenes: Names = (), preset: Preset = "default", train: TrainConfig = defaults.train,
        device: DeviceName = "auto", again: bool = False, work: Work = WORK,
    ) -> None:  # fmt: skip
        """Whole runs on the NVIDIA Dynamic Scenes: the other cameras of the rig; beside published figures.

        Results as of benchmark davis, in OUT/nvidia.md and OUT/nvidia.html.

        Args:
            root: Folder with nvidia/<scene>, each raw (mv_images and poses_bounds.npy), of twelve images (images,
                poses_bounds.npy and v000_t000.png ...), or as Dynamic Gaussian Marbles has them (camera, rgb and splits).
            out: Folder for everything that comes out.
            scenes: Names of the scenes to run; the default is all of them.
            preset: How it is trained: fast, default, paper or high. Frames and their size are the protocol's.
            train: Settings of training that differ from the preset's; the tables name them.
            device: What to compute on.
            again: Forget what is in OUT of these scenes; leave it out to go on from where that was stopped.
            work: How the benchmark is done.
        """
        from flowsplat_benchmarks.datasets import nvidia_cases, run_benchmark

        run_benchmark("nvidia", nvidia_cases(root, scenes, preset, with_training(defaults, train, device)), out, again, work)

    return nvidia


COMMAND = Command(build, place=40)
