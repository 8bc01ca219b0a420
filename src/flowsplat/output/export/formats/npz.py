"""Every parameter of the 4D scene as an ``.npz``; its member ``about`` is JSON text."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from flowsplat.common.files import write_npz
from flowsplat.common.registry import Entry
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.export.parameters import about_parameters, estimate_parameters_bytes, parameter_tensors
from flowsplat.scenes import Scene


def write(path: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """Write one file atomically."""
    arrays = {name: value.numpy() for name, value in parameter_tensors(model).items()}
    write_npz(path, {**arrays, "about": np.array(json.dumps(about_parameters(model)))})


NPZ = Exporter(write, estimate_parameters_bytes, "gaussians.npz", keeps_slopes=True)
EXPORTERS.add(Entry("npz", "NumPy", "Every parameter of the 4D scene, as arrays.", NPZ, place=60))
