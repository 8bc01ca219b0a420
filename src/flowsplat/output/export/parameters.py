"""Export every parameter of the 4D scene in one file, by the names of docs/method.md; docs/formats.md has the schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from flowsplat import __version__
from flowsplat.common.files import write_npz
from flowsplat.common.settings import to_plain
from flowsplat.gaussians.model import SceneModel
from flowsplat.training.checkpoint import write_tensors

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


def write_parameters_npz(path: Path, model: SceneModel) -> None:
    """An ``.npz``; its member ``about`` is JSON text.

    Raises:
        InputError: it cannot be written.
    """
    arrays = {name: value.numpy() for name, value in _tensors(model).items()}
    write_npz(path, {**arrays, "about": np.array(json.dumps(about_parameters(model)))})


def write_parameters_safetensors(path: Path, model: SceneModel) -> None:
    """A ``.safetensors``; the metadata ``values`` is JSON text.

    Raises:
        InputError: it cannot be written.
    """
    write_tensors(path, _tensors(model), about_parameters(model))


def _tensors(model: SceneModel) -> dict[str, Tensor]:
    gaussians = model.gaussians
    seen = {} if gaussians.seen is None else {"seen": gaussians.seen}
    return {**gaussians.params, "dynamic": gaussians.dynamic, "object_ids": gaussians.object_ids, **seen}
