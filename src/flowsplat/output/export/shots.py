"""Export the shots of a clip as one page that plays them one after the other."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat.common.files import make_folder
from flowsplat.common.progress import report
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.api import export_scene
from flowsplat.output.export.formats import EXPORTERS
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.player.page import make_iframe
from flowsplat.output.player.sequence import write_sequence
from flowsplat.scenes import Scene


def export_sequence(
    shots: Sequence[tuple[str, SceneModel, Scene]], path: Path, title: str, options: ExportOptions
) -> Path:  # fmt: skip
    """Write the page.

    Args:
        shots: what each is called, its trained scene, and the prepared one that it was trained on.
        path: the file.
        title: name of the clip.
        options: as ``export_scene`` takes them: ``max_gaussians`` of each shot, ``size_mb`` of all together.

    Raises:
        InputError: an option does not fit, or the file cannot be written.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder, html is one file: give a name for it with -o.")
    make_folder(path.parent)
    share = None if options.size_mb is None else options.size_mb / len(shots)
    with tempfile.TemporaryDirectory() as folder:
        pages = []
        for k, (_, model, scene) in enumerate(shots):
            page = export_scene(model, scene, "html", Path(folder) / f"{k}.html", replace(options, size_mb=share), is_part=True)
            pages.append(page.read_text(encoding="utf-8"))
    write_sequence(path, pages, [name for name, _, _ in shots], title)
    if (note := EXPORTERS["html"].note) is not None:
        report(note)
    if options.embed:
        report(make_iframe(path, title, shots[0][2].width, shots[0][2].height))
    return path
