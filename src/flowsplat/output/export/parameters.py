"""Every parameter of the 4D scene in one file, by the names of docs/method.md; docs/formats.md has the schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from flowsplat import __version__
from flowsplat.common.files import write_npz
from flowsplat.common.settings import to_plain
from flowsplat.gaussians.model import SceneModel
from flowsplat.training.checkpoint import write_tensors

VERSION = 1


def about_parameters(model: SceneModel) -> dict[str, Any]:
    """What the arrays mean: settings of the motion model, and how scene and clip are normalised."""
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


def write_parameters_npz(path: Path, model: SceneModel) -> None:
    """An ``.npz``; its member ``about`` is JSON text.

    Raises:
        InputError: it cannot be written.
    """
    arrays = {name: value.numpy() for name, value in model.gaussians.params.items()}
    write_npz(
        path, {**arrays, "dynamic": model.gaussians.dynamic.numpy(), "about": np.array(json.dumps(about_parameters(model)))}
    )


def write_parameters_safetensors(path: Path, model: SceneModel) -> None:
    """A ``.safetensors``; the metadata ``values`` is JSON text.

    Raises:
        InputError: it cannot be written.
    """
    write_tensors(path, {**model.gaussians.params, "dynamic": model.gaussians.dynamic}, about_parameters(model))
