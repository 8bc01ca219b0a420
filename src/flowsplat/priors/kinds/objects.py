"""Objects: how each moves and how far away it is. A step of depth of our own; other depth knows where objects are."""

from __future__ import annotations

from collections.abc import Collection

from flowsplat.common.errors import InputError
from flowsplat.priors.kinds.object_depth import name_object_depth, open_object_depth
from flowsplat.priors.kinds.static_depth import STATIC, computes_own_depth, has_masks
from flowsplat.priors.objects import objects_stage
from flowsplat.priors.prior import Kind, PriorRequest, Stage


def _compute(request: PriorRequest) -> Stage:
    monocular = open_object_depth(request)
    return lambda: objects_stage(request.scene, request.estimate, request.memory[STATIC], request.hints, monocular)


def _is_due(request: PriorRequest) -> bool:
    """Not where depth is half done: that belongs to the objects that were found for it."""
    scene = request.scene
    if not (computes_own_depth(request) and has_masks(scene) and scene.has_tracks):
        return False
    fits = scene.prior("objects") is not None and (not request.hints or _has_hints(request)) and not _lacks_monocular(request)
    return not (fits and any(scene.has_depth(i) for i in scene.train_frames))


def _has_hints(request: PriorRequest) -> bool:
    """Return whether the objects that are there were placed with these hints."""
    return (request.scene.prior("objects") or {}).get("hints", []) == [hint.text for hint in request.hints]


def _lacks_monocular(request: PriorRequest) -> bool:
    """Return whether the objects that are there were placed without the monocular depth that is asked for."""
    name = name_object_depth(request)
    return name is not None and (request.scene.prior("objects") or {}).get("monocular") != name


def _differs(request: PriorRequest, asked: str | None) -> bool:
    placed_otherwise = (bool(request.hints) and not _has_hints(request)) or _lacks_monocular(request)
    return placed_otherwise and request.method("depth") is not None


def _check_renewal(request: PriorRequest, stale: Collection[str]) -> None:
    if "depth" not in stale:
        depth = request.method("depth")
        raise InputError(
            f"The scene has depth already ({depth}), in which --contact, --same-depth and --object-depth place nothing."
        )


OBJECTS = Kind(
    compute=_compute,
    options=("contact", "same_depth", "object_depth"),
    files=("objects.json", "objects.npz"),
    own=("motion",),
    differs=_differs,
    check_renewal=_check_renewal,
    is_due=_is_due,
)
