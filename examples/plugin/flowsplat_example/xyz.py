"""The centers of the Gaussians at one time as text: x y z red green blue, a line each."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flowsplat.common.files import write_text
from flowsplat.common.registry import Entry
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.export.still import middle_or, still_at
from flowsplat.scenes import Scene


def write(path: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """Write one file atomically."""
    still = still_at(model, middle_or(model, options.time))
    rows = np.concatenate([still.means.numpy(), np.rint(255 * still.colors.numpy())], 1)
    write_text(path, "".join("{:.6g} {:.6g} {:.6g} {:.0f} {:.0f} {:.0f}\n".format(*row) for row in rows.tolist()))


def estimate_bytes(model: SceneModel, scene: Scene, options: ExportOptions) -> int:
    """Return about how many it will be."""
    return 40 * model.active_count(middle_or(model, options.time))


XYZ = Exporter(write, estimate_bytes, "scene.xyz", is_of_one_time=True)
EXPORTERS.add(Entry("xyz", "XYZ", "Centers and colors as text, at one time.", XYZ))
