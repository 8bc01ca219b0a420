"""The commands behind ``flowsplat benchmark``, one file each, found by its name; here is what several of them share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from flowsplat.cli.arguments import NO_PREFIX
from flowsplat.common.devices import DeviceName, pick_device
from flowsplat.pipeline.config import RunConfig
from flowsplat.training.config import TrainConfig
from flowsplat_benchmarks.resume import BenchmarkOptions

Root = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA_ROOT")]
Work = Annotated[BenchmarkOptions, NO_PREFIX]
WORK = BenchmarkOptions()
Names = tuple[str, ...]
Numbers = tuple[int, ...]


def with_training(defaults: RunConfig, train: TrainConfig, device: DeviceName) -> RunConfig:
    """Return the settings of the runs of a benchmark.

    Raises:
        InputError: the device does not work here.
    """
    pick_device(device)
    return replace(defaults, train=train, device=device)
