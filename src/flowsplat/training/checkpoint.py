"""Tensors and plain values as files: safetensors for the numbers, JSON for the rest."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from flowsplat.common.errors import InputError
from flowsplat.common.files import atomic_path, read_json, write_json
from flowsplat.common.progress import say_once
from flowsplat.common.settings import to_plain
from flowsplat.gaussians.gaussians4d import Gaussians4D, ModelConfig
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Similarity

MODEL_VERSION = 2
"""1 had no ``movers``; such models are read."""
RENAMED_FIGURES = {"open": "coverage"}
"""Figures of the history that had another name in an earlier version, and their name now."""


def write_tensors(path: Path, tensors: Mapping[str, Tensor], values: Mapping[str, Any]) -> None:
    """Write tensors and JSON-able values into one safetensors file, atomically."""
    with atomic_path(path) as temporary:
        contiguous = {name: tensor.contiguous() for name, tensor in tensors.items()}
        try:
            save_file(contiguous, temporary, metadata={"values": json.dumps(values)})
        except SafetensorError as error:
            # Its writer reports a full disk as text.
            raise OSError(28 if "No space" in str(error) else 5, str(error)) from error


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The inverse of ``write_tensors``.

    Raises:
        InputError: missing, truncated or damaged.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist.")
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return tensors, json.loads((file.metadata() or {}).get("values", "{}"))
    except (SafetensorError, json.JSONDecodeError, OSError) as error:
        raise InputError(f"{path} is damaged or truncated ({error}). Delete it to compute it again.") from error


def stored_movers(tensors: Mapping[str, Tensor]) -> Tensor:
    """[N] uint8 whose the Gaussians of a model or a checkpoint are; 0 for all where it was written before they had numbers."""
    return tensors.get("movers", torch.zeros_like(tensors["dynamic"])).to(torch.uint8)


def present_figures(history: Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
    """Entries of a history with the names that figures have now; a line says which had another one."""
    found = [{RENAMED_FIGURES.get(name, name): value for name, value in entry.items()} for entry in history]
    for before in {name for entry in history for name in entry if name in RENAMED_FIGURES}:
        say_once(f"The figure {before} of the history of training is called {RENAMED_FIGURES[before]} now.")
    return found


def save_model(folder: Path, model: SceneModel) -> None:
    """Write a trained model: ``gaussians.safetensors`` and a ``model.json`` that a person can read."""
    g = model.gaussians
    write_tensors(folder / "gaussians.safetensors", {**g.params, "dynamic": g.dynamic, "movers": g.movers}, {})
    value = {
        "version": MODEL_VERSION,
        "gaussians": len(g),
        "dynamic": int(g.dynamic.sum()),
        "movers": {str(number): count for number, count in g.mover_counts.items()},
        "model": to_plain(g.config),
        "sh_degree": g.sh_degree,
        "similarity": model.similarity.to_json(),
        "first": model.first,
        "last": model.last,
        "flow_model": model.flow_model,
        "fill": model.fill,
        "focal": model.focal,
    }
    write_json(folder / "model.json", value)


def has_model(folder: Path) -> bool:
    """Whether the files of a trained model are there."""
    return all((folder / name).exists() for name in ("model.json", "gaussians.safetensors"))


def load_model(folder: Path) -> SceneModel:
    """Read what ``save_model`` wrote.

    Raises:
        InputError: missing, damaged, or of a newer version.
    """
    value = read_json(folder / "model.json")
    try:
        if int(value["version"]) > MODEL_VERSION:
            raise InputError(f"{folder} was written by a newer flowsplat (model version {value['version']}). Update flowsplat.")
        tensors, _ = read_tensors(folder / "gaussians.safetensors")
        dynamic, movers = tensors["dynamic"].to(torch.bool), stored_movers(tensors)
        params = {name: tensor for name, tensor in tensors.items() if name not in ("dynamic", "movers")}
        gaussians = Gaussians4D(params, dynamic, ModelConfig(**value["model"]), int(value["sh_degree"]), movers)
        return SceneModel(
            gaussians, Similarity.from_json(value["similarity"]), float(value["first"]), float(value["last"]),
            value["flow_model"], bool(value["fill"]), float(value.get("focal", 0.0)),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder} does not hold a trained model: {error}.") from error


def load_checkpoint(
    folder: Path, similarity: Similarity, first: float, last: float, focal: float
) -> tuple[SceneModel, int, int]:
    """Read the newest checkpoint that a trainer left, to look at it: a training that is still running is not disturbed.

    Args:
        folder: of the checkpoints.
        similarity: scene to normalised coordinates.
        first: seconds of the first frame.
        last: seconds of the last frame.
        focal: focal length in pixels of the training frames.

    Returns:
        the model, and after which step of how many it was written.

    Raises:
        InputError: there is none, or it is damaged or being replaced at this moment.
    """
    path = folder / str(read_json(folder / "latest.json").get("file"))
    tensors, values = read_tensors(path)
    try:
        config = values["config"]
        params = {name.removeprefix("param."): value for name, value in tensors.items() if name.startswith("param.")}
        dynamic, movers = tensors["dynamic"].bool(), stored_movers(tensors)
        gaussians = Gaussians4D(params, dynamic, ModelConfig(**config["model"]), int(values["sh_degree"]), movers)
        model = SceneModel(gaussians, similarity, first, last, config["flow_model"], bool(config["fill"]), focal)
        return model, int(values["step"]), int(config["iterations"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} holds no checkpoint that can be shown: {error}.") from error
