"""The whole 4D scene as ``.4dgs``, a container of Gaussians that move on straight lines (https://4dgs.dev, version 1, draft).

Curves become pieces: as many Gaussians one after the other (``export/fourdgs/pieces.py``). The clip's camera is in it twice, as a
view that players may begin with, and exactly, as a calibrated sensor on its way; and its sound is. y is up and z backward.
"""

from __future__ import annotations

from pathlib import Path

from flowsplat.common.registry import Entry
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.options import ExportOptions
from flowsplat.scenes import Scene


def write(path: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """Write one file atomically."""
    from flowsplat.output.export.fourdgs.writing import write_scene

    write_scene(path, model, scene, has_sound=options.sound)


def estimate_bytes(model: SceneModel, scene: Scene, options: ExportOptions) -> int:
    """Return about how many it will be: a part of the Gaussians is cut into pieces for it."""
    from flowsplat.output.export.fourdgs.writing import estimate_scene_bytes

    return estimate_scene_bytes(model, scene, options.sound)


SENTENCE = "Avala AI's .4dgs: the whole scene, its curves as straight pieces; objects, camera and sound."
FOURDGS = Exporter(write, estimate_bytes, "scene.4dgs", rounds=True, holds_sound=True)
EXPORTERS.add(Entry("4dgs", "4DGS", SENTENCE, FOURDGS, place=57))
