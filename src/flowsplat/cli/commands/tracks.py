"""``flowsplat tracks``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from flowsplat.cli.arguments import Run, Target
from flowsplat.cli.command import Command
from flowsplat.common.progress import report
from flowsplat.common.run_paths import RunPaths

# --at A B, --at A --at B and both together are all understood.
Points = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="U,V,FRAME [...]")]


def tracks(out: Run, at: Points = (), queries: Path | None = None, path: Target = None) -> None:
    """Follow points through a trained run: where what is seen at a pixel goes in 3D, and when it is visible.

    Writes queries, timestamps, points [Q, T, 3] in the coordinates of RUN/scene/cameras.json, visible [Q, T], and object_ids [Q],
    the number of the object that each point is on.

    Args:
        out: Folder of the run.
        at: Points to follow, each u,v,frame: pixels of the prepared frames (the center of the first is 0.5,0.5), and the
            number of the frame. Repeat it for more.
        queries: More of them: a .json with a list of [u, v, frame], or a text with u,v,frame on every line.
        path: File to write, .json or .npz; without it RUN/export/tracks.json.
    """
    from flowsplat import pipeline
    from flowsplat.output.tracks import read_queries, write_tracks
    from flowsplat.scenes import Scene

    out = pipeline.resolve_run(out)
    model, scene = pipeline.load(out), Scene(RunPaths(out).scene_path)
    wanted = read_queries([point for some in at for point in some], queries, scene)
    written, found = write_tracks(model, scene, wanted, path or out / "export" / "tracks.json")
    report(f"Written: {written}. {found} of {len(wanted)} points lie on something and were followed.")


COMMAND = Command(lambda _: tracks, place=120)
