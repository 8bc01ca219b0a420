"""Every parameter of the 4D scene as ``.safetensors``; the metadata ``values`` is JSON text."""

from __future__ import annotations

from pathlib import Path

from flowsplat.common.registry import Entry
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.formats import EXPORTERS, Exporter
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.export.parameters import about_parameters, estimate_parameters_bytes, parameter_tensors
from flowsplat.scenes import Scene
from flowsplat.training.checkpoint import write_tensors


def write(path: Path, model: SceneModel, scene: Scene, options: ExportOptions) -> None:
    """Write one file atomically."""
    write_tensors(path, parameter_tensors(model), about_parameters(model))


SAFETENSORS = Exporter(write, estimate_parameters_bytes, "gaussians.safetensors", keeps_slopes=True)
EXPORTERS.add(Entry("safetensors", "Safetensors", "Every parameter of the 4D scene, as tensors.", SAFETENSORS, place=70))
