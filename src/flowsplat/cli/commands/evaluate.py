"""``flowsplat evaluate``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from flowsplat.cli.arguments import Run
from flowsplat.cli.command import Command
from flowsplat.cli.runs import change_run, print_figures, run_defaults
from flowsplat.common.devices import DeviceName
from flowsplat.pipeline.config import Baselines, RunConfig


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command with these settings by default."""

    def evaluate(
        out: Run, baselines: Baselines = defaults.baselines, refine_poses: bool = defaults.refine_poses,
        lpips: Path | None = None, device: DeviceName = defaults.device,
    ) -> None:  # fmt: skip
        """Measure a trained run on what was held out; writes metrics.json and report.html.

        Args:
            out: Folder of the run.
            baselines: What the result is compared with; all also trains our own static scene (a quarter of the training time).
            refine_poses: Also measure held-out frames with their poses refined on their own images.
            lpips: File of AlexNet's weights (torchvision's alexnet-owt-7be5be79.pth): also measure LPIPS by them. A run that is
                measured already is measured again, and not trained. Left out, LPIPS is measured where torchvision has its weights.
            device: What to compute on.
        """
        from flowsplat import pipeline

        out = pipeline.resolve_run(out)
        with change_run(out, baselines=baselines, refine_poses=refine_poses, device=device) as folder:
            metrics = pipeline.evaluate_run(folder, lpips)
        print_figures(metrics, out)

    return evaluate


COMMAND = Command(build, run_defaults, place=50)
