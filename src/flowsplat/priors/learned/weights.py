"""Getting a network with its weights: from the user's cache or folder, else from the network, else a clear word."""

from __future__ import annotations

import importlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from flowsplat.common.errors import InputError, describe_install, first_line


@dataclass(frozen=True)
class ModelOptions:
    """Which weights the learned priors use: a folder of yours, or a name on the Hugging Face hub, taken from its cache or
    fetched once."""

    raft: str = "large"
    """RAFT: large or small, with torchvision's weights, or your own file (.pth) of such weights or of those of its authors
    (raft-things.pth, raft-small.pth)."""
    depth_anything: str = "depth-anything/Depth-Anything-V2-Small-hf"
    """Depth Anything."""
    depth_pro: str = "apple/DepthPro-hf"
    """Depth Pro."""
    sam2: str = "facebook/sam2.1-hiera-tiny"
    """SAM 2."""
    sam3: str = "facebook/sam3"
    """SAM 3."""
    edgetam: str = "yonigozlan/EdgeTAM-hf"
    """EdgeTAM."""


def network_device(name: str) -> torch.device:
    """Return where networks run: ``auto`` is a GPU where PyTorch sees one."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


def require_package(module: str, option: str, instead: str, install: str = "") -> Any:
    """Import a package of the extra ``learned``.

    Args:
        option: what the user chose, as it is typed.
        instead: what to type to do without.
        install: what to type for a package that the extra does not bring.

    Raises:
        InputError: it is not installed, or does not work with this PyTorch.
    """
    try:
        return importlib.import_module(module)
    except Exception as error:  # missing: ImportError; built for another PyTorch: RuntimeError, OSError
        raise InputError(
            f"{option} needs {module}, which cannot be imported ({first_line(error)}): "
            f"{install or describe_install('learned')}, or do without: {instead}."
        ) from error


def from_hub(kind: Any, source: str, *, option: str, setting: str, instead: str) -> Any:
    """``kind.from_pretrained(source)`` with every weight in its place.

    Args:
        kind: a class of transformers: a model, or what prepares its input.
        source: folder or hub id.
        option: what the user chose, as it is typed.
        setting: the option that names the source.
        instead: what to type to do without.

    Raises:
        InputError: the source is not there, cannot be fetched, is damaged or holds another model.
    """
    from transformers import PreTrainedModel
    from transformers.utils import logging

    verbosity = logging.get_verbosity()
    logging.set_verbosity_error()  # It reports missing weights in a long table; the check below says it in a line.
    logging.disable_progress_bar()
    try:
        if looks_like_path(source) and not os.path.isdir(source):
            raise FileNotFoundError("there is no such folder")
        if not issubclass(kind, PreTrainedModel):
            return kind.from_pretrained(source)
        model, report = kind.from_pretrained(source, output_loading_info=True)
    except Exception as error:  # no such folder or name, no network, no permission, truncated, another model
        raise InputError(
            f"{option}: the model {source} can be neither found nor fetched ({first_line(error)}). {_remedy(source, setting)}, "
            f"or do without: {instead}."
        ) from error
    finally:
        logging.set_verbosity(verbosity)
        logging.enable_progress_bar()
    lacking = [*report["missing_keys"], *report["mismatched_keys"]]
    if lacking:
        raise InputError(
            f"{option}: {source} is no complete {type(model).__name__}, it lacks {len(lacking)} of its weights. "
            f"{_remedy(source, setting)}, or do without: {instead}."
        )
    return model.float().eval()


def looks_like_path(source: str) -> bool:
    """Return whether a source is meant as a folder: names on the hub have at most one slash, and none at their start."""
    return os.path.isdir(source) or source.startswith((".", "/", "~", "\\")) or source.count("/") > 1 or Path(source).is_absolute()


def _remedy(source: str, setting: str) -> str:
    if looks_like_path(source):
        return f"Give the folder of a whole checkpoint with {setting} FOLDER"
    return f"Fetch it with: hf download {source}; or name a folder with {setting} FOLDER"


def state_dict_file(path: Path, *, option: str, setting: str, instead: str) -> dict[str, torch.Tensor]:
    """Return the weights in a ``.pth`` file; nothing but tensors is read.

    Raises:
        InputError: missing, or not such a file.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
            raise ValueError("it holds no weights")
    except Exception as error:  # a damaged file raises whatever the unpickler stumbles over
        raise InputError(
            f"{option}: {path} cannot be read ({first_line(error)}). Give a file of weights with {setting} FILE, "
            f"or do without: {instead}."
        ) from error
    return state
