"""Monocular depth that only helps to tell how far away objects are, by a network or the user's."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from flowsplat.priors.background.monocular_maps import Monocular
from flowsplat.priors.given.depth import open_depth
from flowsplat.priors.given.depth_check import match_training_frames, monocular_of, require_told
from flowsplat.priors.given.fitting import verdict_of
from flowsplat.priors.learned.weights import network_device
from flowsplat.priors.prior import GIVEN, PriorRequest

_OPENED = "object depth"
"""Key of ``PriorRequest.memory``."""


def name_object_depth(request: PriorRequest) -> str | None:
    """Return where it comes from; None where none is asked for."""
    if request.options.given.object_depth is not None:
        return GIVEN
    chosen = request.choice("object_depth")
    return None if chosen == "none" else chosen


def open_object_depth(request: PriorRequest) -> Callable[[], Monocular] | None:
    """Return what gives it, its network loaded or its files read once; None where none is asked for.

    Raises:
        InputError: the weights are not there, or files cannot be read.
    """
    if name_object_depth(request) is None:
        return None
    if _OPENED not in request.memory:
        path = request.options.given.object_depth
        request.memory[_OPENED] = _load(request) if path is None else _read(request, path)
    opened: Callable[[], Monocular] = request.memory[_OPENED]
    return opened


def _load(request: PriorRequest) -> Callable[[], Monocular]:
    from flowsplat.priors.learned.depth import predict_depth

    name, device = request.choice("object_depth"), network_device(request.device)
    source = predict_depth(name, request.scene, request.options.models, device, f"--object-depth {name}")
    return lambda: source


def _read(request: PriorRequest, path: Path) -> Callable[[], Monocular]:
    scene, depth = request.scene, open_depth(path, request.scene)
    told = request.options.given.depth_kind or (depth.kind if depth.is_certain else None)
    matches = match_training_frames(scene)
    if told is None:
        require_told(scene, path, matches)
    return lambda: monocular_of(scene, depth, matches, path, told, verdict_of(path, depth.maker))
