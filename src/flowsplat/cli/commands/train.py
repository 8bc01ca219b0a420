"""``flowsplat train``."""

from __future__ import annotations

from collections.abc import Callable

from flowsplat.cli.arguments import Preset, Run
from flowsplat.cli.command import Command
from flowsplat.cli.runs import change_run, run_defaults
from flowsplat.common.devices import DeviceName
from flowsplat.common.progress import report
from flowsplat.pipeline.config import RunConfig
from flowsplat.training.config import TrainConfig


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command with these settings by default."""

    def train(
        out: Run, preset: Preset = "default", train: TrainConfig = defaults.train, device: DeviceName = defaults.device
    ) -> None:
        """Train a prepared run; continues from its last checkpoint.

        Args:
            out: Folder of the run.
            preset: Start from these settings instead of those stored in the run.
            train: Settings that differ from the stored ones; they are stored in their place.
            device: What to compute on.
        """
        from flowsplat import pipeline

        out = pipeline.resolve_run(out)
        with change_run(out, train=train, device=device) as folder:
            pipeline.train(folder)
        report(f"Trained: {out}/model. Next: flowsplat evaluate {out}")

    return train


COMMAND = Command(build, run_defaults, place=40)
