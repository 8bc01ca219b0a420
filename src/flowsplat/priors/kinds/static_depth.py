"""The static scene behind objects, twice: as all matches show it, for masks to differ from; and with masks, for depth."""

from __future__ import annotations

from flowsplat.priors.background.matched_clip import SOLUTIONS, MatchedClip
from flowsplat.priors.background.static_depth import static_depth
from flowsplat.priors.prior import Kind, PriorRequest, Stage
from flowsplat.scenes import Scene

STATIC = "static depth"
"""Key of ``Request.memory``: the matched clip and its static scene, masks considered."""


def has_masks(scene: Scene) -> bool:
    """Return whether every training frame has a mask."""
    return all(scene.has_mask(i) for i in scene.train_frames)


def computes_own_depth(request: PriorRequest) -> bool:
    """Return whether depth is to be computed, and from matches."""
    return request.computes("depth") and request.choice("depth") == "multiview"


def _compute(request: PriorRequest) -> Stage:
    def stage() -> None:
        clip = MatchedClip(request.scene, request.estimate)
        request.memory[STATIC] = clip, static_depth(clip, has_masks(request.scene))

    return stage


STATIC_DEPTH = Kind(files=(SOLUTIONS,), overwrites=True, is_scratch=True)
MASKED_STATIC_DEPTH = Kind(compute=_compute, is_due=computes_own_depth)
