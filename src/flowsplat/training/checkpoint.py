"""Tensors and plain values as files: safetensors for the numbers, JSON for the rest."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from typing_extensions import NotRequired, TypedDict

from flowsplat.common.bounds import bounds_of, problem
from flowsplat.common.errors import InputError, first_line
from flowsplat.common.files import atomic_path, check_json, ordinary_file, plain_name, read_json, write_json
from flowsplat.common.files.json_file import Count, Number, SimilarityFile, Text, Versioned
from flowsplat.common.settings import to_plain
from flowsplat.gaussians.flow import FlowModel
from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.geometry import Similarity
from flowsplat.geometry.cameras import MAX_COORDINATE
from flowsplat.scenes import Scene

MODEL_VERSION = 5
_FOUND = ("seen", "shadow_free")
"""What is found when training ends, where it was."""
_SHARED_PREFIX = "shared."
"""Before the names of parameters that Gaussians share, which are no rows."""
_SIMILARITY_TOLERANCE = 1e-6
"""By how much numbers of one similarity may differ, relatively or in all. Chosen by eye."""
_MAX_LOG = 80.0
"""Logarithm of what still is a float32."""
_MAX_LOG_GAIN = 40.0
"""Logarithm of a factor of brightness, at most: times colors of ``MAX_COORDINATE`` it still is a float32. Trained ones stay
below 6."""


def write_tensors(path: Path, tensors: Mapping[str, Tensor], values: Mapping[str, Any]) -> None:
    """Write tensors and JSON-able values into one safetensors file, atomically."""
    with atomic_path(path) as temporary:
        contiguous = {name: tensor.contiguous() for name, tensor in tensors.items()}
        try:
            save_file(contiguous, temporary, metadata={"values": json.dumps(values)})
        except SafetensorError as error:
            # Its writer reports a full disk as text.
            raise OSError(28 if "No space" in str(error) else 5, str(error)) from error


def read_tensors(path: Path, rows: int | None = None) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return the inverse of ``write_tensors``.

    Args:
        rows: how many every tensor must have that is not shared; looked at before any of them is read.

    Raises:
        InputError: missing, no ordinary file, truncated, damaged, or of another number of rows.
    """
    ordinary_file(path)
    try:
        with safe_open(path, framework="pt") as file:
            names = list(file.keys())
            for name in (name for name in names if rows is not None and not name.startswith(_SHARED_PREFIX)):
                shape = file.get_slice(name).get_shape()
                if not shape or shape[0] != rows:
                    raise InputError(f"{path} is damaged: {name} has shape {shape}, and there are {rows:,} Gaussians.")
            tensors = {name: file.get_tensor(name) for name in names}
            values = json.loads((file.metadata() or {}).get("values", "{}"))
    except (SafetensorError, OSError, ValueError, TypeError, RecursionError, RuntimeError) as error:
        raise InputError(f"{path} is damaged or truncated ({first_line(error)}). Delete it to compute it again.") from error
    if not isinstance(values, dict):
        raise InputError(f"{path} is damaged: its values are no object. Delete it to compute it again.")
    return tensors, values


class ModelFile(TypedDict):
    """What ``model.json`` holds; more may stand there."""

    gaussians: Count
    dynamic: Count
    objects: NotRequired[dict[str, Count]]
    model: ModelConfig
    sh_degree: Annotated[int, Meta(ge=0, le=3)]
    similarity: SimilarityFile
    first: Number
    last: Number
    flow_model: FlowModel
    fill: bool
    focal: NotRequired[Number]


class LatestFile(TypedDict):
    """What ``latest.json`` holds."""

    file: Text


class CheckpointFile(TypedDict):
    """The plain values of a checkpoint."""

    step: Count
    sh_degree: Count
    queue: list[Count]
    rng: dict[str, Any]
    neighbors_found: Count
    recent: list[dict[str, float]]
    averaged: Count
    seconds: Number
    history: list[dict[str, float]]
    config: dict[str, Any]


def save_model(folder: Path, model: SceneModel) -> None:
    """Write a trained model: ``gaussians.safetensors`` and a ``model.json`` that a person can read."""
    g = model.gaussians
    known = {name: value for name in _FOUND if (value := getattr(g, name)) is not None}
    shared = {f"{_SHARED_PREFIX}{name}": value for name, value in g.shared.items()}
    tensors = {**g.params, **shared, "dynamic": g.dynamic, "object_ids": g.object_ids, **known}
    write_tensors(folder / "gaussians.safetensors", tensors, {})
    value = {
        "version": MODEL_VERSION,
        "gaussians": len(g),
        "dynamic": int(g.dynamic.sum()),
        "objects": {str(number): count for number, count in g.object_counts.items()},
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
    """Return whether the files of a trained model are there."""
    return all((folder / name).exists() for name in ("model.json", "gaussians.safetensors"))


def load_model(folder: Path) -> SceneModel:
    """Read what ``save_model`` wrote.

    Raises:
        InputError: missing, damaged, or of another version.
    """
    path = folder / "model.json"
    value = read_json(path, Versioned)
    if value["version"] > MODEL_VERSION:
        raise InputError(f"{folder} was written by a newer flowsplat (model version {value['version']}). Update flowsplat.")
    if value["version"] < MODEL_VERSION:
        raise InputError(f"{folder} was written by an earlier flowsplat (model version {value['version']}): train it anew.")
    check_json(path, value, ModelFile)
    try:
        tensors, _ = read_tensors(folder / "gaussians.safetensors", value["gaussians"])
        dynamic, object_ids = tensors["dynamic"].to(torch.bool), tensors["object_ids"].to(torch.uint8)
        shared = _take_shared(tensors)
        others = {"dynamic", "object_ids", *_FOUND, *(f"{_SHARED_PREFIX}{name}" for name in shared)}
        params = {name: tensor for name, tensor in tensors.items() if name not in others}
        found = {name: tensors.get(name) for name in _FOUND}
        gaussians = Gaussians4D(
            params, dynamic, ModelConfig(**value["model"]), value["sh_degree"], object_ids, **found, shared=shared
        )
        check_model(folder, gaussians)
        if not value["last"] > value["first"]:
            raise ValueError("its last frame is not after its first")
        focal = float(value.get("focal", 0.0))
        if not (focal == 0 or 1 / MAX_COORDINATE <= focal <= MAX_COORDINATE):
            raise ValueError(f"its focal length is {focal:g} pixels")
        return SceneModel(
            gaussians, Similarity.from_json(value["similarity"]), float(value["first"]), float(value["last"]),
            value["flow_model"], bool(value["fill"]), focal,
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, ArithmeticError) as error:
        raise InputError(f"{folder} does not hold a trained model: {error}.") from error


def fits_scene(model: SceneModel, scene: Scene) -> bool:
    """Return whether a model is in the coordinates of a scene, but for last digits: those of another machine may be others."""
    if scene.info.similarity is None:
        return False
    ours, its = (
        np.concatenate([np.ravel(each["rotation"]), np.ravel(each["translation"]), [each["scale"]]])
        for each in (model.similarity.to_json(), scene.info.similarity)
    )
    return bool(np.allclose(ours, its, rtol=_SIMILARITY_TOLERANCE, atol=_SIMILARITY_TOLERANCE))


def check_scene(path: Path, model: SceneModel, scene: Scene) -> None:
    """Refuse the model of a scene that was prepared anew with others of its priors: cameras and depth have other coordinates now.

    Args:
        path: of the model, for the message.

    Raises:
        InputError: says what to do.
    """
    if not fits_scene(model, scene):
        raise InputError(f"{path} was trained before {scene.folder} was prepared anew: run flowsplat train on it again.")


def _take_shared(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(_SHARED_PREFIX): value for name, value in tensors.items() if name.startswith(_SHARED_PREFIX)}


def check_model(path: Path, gaussians: Gaussians4D) -> None:
    """Refuse Gaussians that nothing could be done with: of other parameters than their motion model has, or not finite.

    Raises:
        InputError: names the parameter.
    """
    for name, bounds in bounds_of(ModelConfig).items():
        if wrong := problem(getattr(gaussians.config, name), bounds):
            raise InputError(f"{path} is damaged: its {name} {wrong}.")
    count, shapes = len(gaussians.dynamic), parameter_shapes(gaussians.config)
    if not 0 <= gaussians.sh_degree <= gaussians.config.sh_degree:
        raise InputError(f"{path} is damaged: its harmonics are of degree {gaussians.config.sh_degree}, not {gaussians.sh_degree}.")
    if set(shapes) != set(gaussians.params):
        others = ", ".join(sorted(set(shapes) ^ set(gaussians.params)))
        raise InputError(f"{path} is damaged: its parameters are not those of its settings ({others}).")
    for name, shape in shapes.items():
        values = gaussians.params[name]
        if values.shape != (count, *shape) or values.dtype != torch.float32:
            raise InputError(f"{path} is damaged: {name} is {values.dtype} {tuple(values.shape)}, expected {(count, *shape)}.")
        _check_finite(path, name, values, _most(name))
    if not bool((gaussians.params["log_gains"].abs().sum(1) <= _MAX_LOG_GAIN).all()):  # cosines may all be 1
        raise InputError(f"{path} is damaged: log_gains add up to more than {_MAX_LOG_GAIN:g}.")
    for name, values in gaussians.shared.items():  # their shapes are those of the model, or they were not Gaussians
        if values.dtype != torch.float32:
            raise InputError(f"{path} is damaged: {name} is {values.dtype}, expected torch.float32.")
        _check_finite(path, name, values, MAX_COORDINATE)
    if gaussians.dynamic.shape != (count,) or gaussians.object_ids.shape != (count,):
        raise InputError(f"{path} is damaged: it does not tell for each Gaussian whether it moves, and of which object it is.")
    seen = gaussians.seen
    if seen is not None and (seen.dtype != torch.float32 or not bool(((seen >= 0) & (seen < torch.inf)).all())):
        raise InputError(f"{path} is damaged: what the clip has seen of a Gaussian is no number, or negative.")
    shadow_free = gaussians.shadow_free
    if shadow_free is not None and (
        shadow_free.dtype != torch.float32 or not bool((shadow_free.abs().sum(1) <= _MAX_LOG_GAIN).all())
    ):
        raise InputError(f"{path} is damaged: how bright a Gaussian is without shadows is no number, or beyond {_MAX_LOG_GAIN:g}.")


def is_storable(name: str, values: np.ndarray) -> np.ndarray:
    """Return which values of a parameter a model may hold (``check_model``)."""
    return (values <= _most(name)) & (values >= -MAX_COORDINATE)  # not for NaN


def _most(name: str) -> float:
    """Return what the values of a parameter are at most."""
    return _MAX_LOG if name.startswith("log_") else MAX_COORDINATE


def _check_finite(path: Path, name: str, values: Tensor, most: float) -> None:
    if not bool((values <= most).all() and (values >= -MAX_COORDINATE).all()):  # not for NaN
        raise InputError(f"{path} is damaged: {name} holds values that are not finite, or beyond {most:g}.")


def check_training_state(
    path: Path, tensors: Mapping[str, Tensor], gaussians: Gaussians4D, statistics: Mapping[str, Tensor]
) -> None:
    """Refuse what a trainer keeps of its Gaussians and could not go on with: its kernels look at no index and no size.

    Args:
        tensors: of the checkpoint: ``adam.*``, ``shared_adam.*``, ``average.*``, ``statistics.*`` and ``neighbors.*``.
        gaussians: that it holds.
        statistics: by name, such as the strategy keeps them.

    Raises:
        InputError: names the tensor.
    """
    count, parameters = len(gaussians), gaussians.values
    if missing := [name for name in statistics if f"statistics.{name}" not in tensors]:
        raise InputError(f"{path} is damaged: it lacks statistics.{missing[0]}.")
    for name, value in tensors.items():
        kind, _, what = name.partition(".")
        shape, dtype = tuple(value.shape), torch.float32
        if kind == "shared":
            continue
        if kind == "average" or what.startswith(("mean.", "square.")):
            of = parameters.get(what.rpartition(".")[2])
            shape = (-1,) if of is None else (*of.shape,) if kind != "shared_adam" else (1, *of.shape)
        elif kind in ("adam", "shared_adam"):
            shape, dtype = (count if kind == "adam" else 1,), torch.int32
        elif kind == "statistics":
            shape, dtype = (tuple(statistics[what].shape), statistics[what].dtype) if what in statistics else ((-1,), dtype)
        elif kind == "neighbors":
            shape = (count, *tensors["neighbors.indices"].shape[1:2])
            dtype = torch.int32 if what == "indices" else torch.float32
        else:
            continue
        if tuple(value.shape) != shape or value.dtype != dtype:
            raise InputError(f"{path} is damaged: {name} is {value.dtype} {tuple(value.shape)}, expected {dtype} {shape}.")
        fits = torch.isfinite(value) if what != "indices" else (value >= -1) & (value < count)
        if not bool(fits.all()):
            raise InputError(f"{path} is damaged: {name} holds values that cannot be.")


def latest_checkpoint(folder: Path) -> Path:
    """Return the newest checkpoint in a folder of them.

    Raises:
        InputError: ``latest.json`` is missing or damaged.
    """
    path = folder / "latest.json"
    return folder / plain_name(read_json(path, LatestFile)["file"], f"{path}: the checkpoint")


def load_checkpoint(folder: Path, similarity: Similarity, first: float, last: float, focal: float) -> tuple[SceneModel, int, int]:
    """Read the newest checkpoint that a trainer left, to look at it: a training that is still running is not disturbed.

    Args:
        folder: of the checkpoints.
        similarity: scene to normalized coordinates.
        first: seconds of the first frame.
        last: seconds of the last frame.
        focal: focal length in pixels of the training frames.

    Returns:
        the model, and after which step of how many it was written.

    Raises:
        InputError: there is none, or it is damaged or being replaced at this moment.
    """
    path = latest_checkpoint(folder)
    tensors, values = read_tensors(path)
    try:
        config = values["config"]
        params = {name.removeprefix("param."): value for name, value in tensors.items() if name.startswith("param.")}
        dynamic, object_ids = tensors["dynamic"].bool(), tensors["object_ids"].to(torch.uint8)
        gaussians = Gaussians4D(
            params, dynamic, ModelConfig(**config["model"]), int(values["sh_degree"]), object_ids, shared=_take_shared(tensors)
        )
        check_model(path, gaussians)
        model = SceneModel(gaussians, similarity, first, last, config["flow_model"], bool(config["fill"]), focal)
        return model, int(values["step"]), int(config["iterations"])
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise InputError(f"{path} holds no checkpoint that can be shown: {error}.") from error
