"""The scene as a page that plays it."""

from __future__ import annotations

from pathlib import Path

from flowsplat.common.registry import Entry
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.formats import EXPORTERS, Exporter, Write
from flowsplat.output.export.options import ExportOptions
from flowsplat.scenes import Scene

_PAGE_BYTES = 200_000
"""The player without its scene: program, poster, camera paths."""
_NOTE = (
    "The page holds the scene, one rendered image and the name of the clip: no frame, no sound, nothing of when or where it was "
    "filmed."
)


def write(path: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """Write one file."""
    begin(model, scene)(path, model, scene, options)


def begin(model: SceneModel, scene: Scene) -> Write:
    """Measure how far the view may be turned, and return what writes pages that know it, also of fewer Gaussians."""
    from flowsplat.output.player.page import write_player
    from flowsplat.output.videos.amplitudes import loop_widths

    widths = loop_widths(model, scene)

    def write_with_widths(path: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
        write_player(path, model, scene.timestamps.tolist(), scene.cameras, scene.name, widths)

    return write_with_widths


def embed(path: Path, scene: Scene) -> str:
    """Return the HTML that shows the page in another one."""
    from flowsplat.output.player.page import make_iframe

    return make_iframe(path, scene.name, scene.width, scene.height)


def estimate_bytes(model: SceneModel, scene: Scene, options: ExportOptions) -> int:
    """Return about how many it will be."""
    from flowsplat.output.player.pack import estimate_bytes as estimate_packed_bytes

    return _PAGE_BYTES + estimate_packed_bytes(model.gaussians)


EXPORTERS.add(
    Entry(
        "html",
        "Page",
        "A page that plays the scene in any browser.",
        Exporter(write, estimate_bytes, "player.html", keeps_slopes=True, rounds=True, note=_NOTE, embed=embed, begin=begin),
        place=10,
    )
)
