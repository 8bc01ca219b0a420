"""What formats of every parameter of the 4D scene hold; docs/formats.md has the schema."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from flowsplat import __version__
from flowsplat.common.settings import to_plain
from flowsplat.gaussians.model import SceneModel
from flowsplat.output.export.options import ExportOptions
from flowsplat.scenes import Scene

VERSION = 1


def about_parameters(model: SceneModel) -> dict[str, Any]:
    """Return what the arrays mean: settings of the motion model, and how scene and clip are normalized."""
    return {
        "format": "flowsplat parameters",
        "version": VERSION,
        "flowsplat": __version__,
        "model": to_plain(model.gaussians.config),
        "sh_degree": model.gaussians.sh_degree,
        "similarity": model.similarity.to_json(),
        "first": model.first,
        "last": model.last,
    }


def parameter_tensors(model: SceneModel) -> dict[str, Tensor]:
    """Return the arrays, by the names of docs/method/representation.md."""
    gaussians = model.gaussians
    seen = {} if gaussians.seen is None else {"seen": gaussians.seen}
    return {**gaussians.values, "dynamic": gaussians.dynamic, "object_ids": gaussians.object_ids, **seen}


def estimate_parameters_bytes(model: SceneModel, scene: Scene, options: ExportOptions) -> int:
    """Return about how many they are: those of all parameters, uncompressed, and of what is known of each Gaussian."""
    gaussians = model.gaussians
    return sum(value.numel() * value.element_size() for value in gaussians.values.values()) + 2 * len(gaussians)
