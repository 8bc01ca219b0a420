"""``flowsplat render``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from flowsplat.cli.arguments import Run, Target
from flowsplat.cli.command import Command
from flowsplat.cli.runs import change_run, run_defaults
from flowsplat.common.devices import DeviceName
from flowsplat.common.errors import InputError
from flowsplat.common.progress import report
from flowsplat.output.videos import RenderOptions
from flowsplat.pipeline.config import RunConfig


def build(defaults: RunConfig) -> Callable[..., None]:
    """Return the command with these settings by default."""

    def render(
        out: Run, render: RenderOptions = defaults.render, device: DeviceName = defaults.device, path: Target = None
    ) -> None:
        """Render videos of a trained run: the input path, an orbit, bullet time, or a camera file, beside those it has.

        Or of a file of static Gaussians of any program (.ply, .splat, .spz), with a camera file or once round its middle.

        Args:
            out: Folder of the run, or a file.
            render: Options that differ from those that the run was started with; for this time only.
            device: What to compute on.
            path: Folder for the videos of a file, empty or missing. None = out/ and the name of the file. A run has its own.
        """
        from flowsplat import pipeline
        from flowsplat.output.splat_files import is_splat_file

        if is_splat_file(out):
            from flowsplat.pipeline.splat_file import render_splat_file

            folder = path or Path("out") / out.stem
            render_splat_file(out, folder, render, device)
            report(f"Videos: {folder}/renders")
            return
        if path is not None:
            raise InputError(f"{out} is a run, whose videos go into {out}/renders: leave out -o, which is for files.")
        out = pipeline.resolve_run(out)
        with change_run(out, device=device) as run:
            pipeline.render_run(run, render)
        report(f"Videos: {out}/renders")

    return render


COMMAND = Command(build, run_defaults, place=60)
