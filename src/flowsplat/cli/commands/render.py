"""``flowsplat render``."""

from __future__ import annotations

from collections.abc import Callable

from flowsplat.cli.arguments import Run
from flowsplat.cli.command import Command
from flowsplat.cli.runs import change_run, run_defaults
from flowsplat.common.devices import DeviceName
from flowsplat.common.progress import report
from flowsplat.output.videos import RenderOptions
from flowsplat.pipeline.config import RunConfig


def build(defaults: RunConfig) -> Callable[..., None]:
    """The command with these settings by default."""

    def render(out: Run, render: RenderOptions = defaults.render, device: DeviceName = defaults.device) -> None:
        """Render videos of a trained run: the input path, an orbit, bullet time, or a camera file, beside those it has.

        Args:
            out: Folder of the run.
            render: Options that differ from those that the run was started with; for this time only.
            device: What to compute on.
        """
        from flowsplat import pipeline

        with change_run(out, device=device) as folder:
            pipeline.render_run(folder, render)
        report(f"Videos: {out}/renders")

    return render


COMMAND = Command(build, run_defaults, place=60)
