"""Choose the Gaussians that matter most: those without which the images of the clip would change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from flowsplat.common.progress import spinner
from flowsplat.common.spread import spread
from flowsplat.gaussians.contribution import sum_contributions
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera

MAX_VIEWS = 48
"""Training frames that are looked at. Chosen by eye."""
KEPT_IN_A_ROUND = 0.85
"""Share of the Gaussians that are kept before it is asked anew who is missed: where one is gone those behind it are. Half of a
scene of bear has 30.9 dB so, 30.5 with .7, and 29.0 in one go (docs/notebook/2026-11.md, "Gaussians that are needed")."""


def choose_most_important(model: SceneModel, views: Sequence[tuple[Camera, float]], count: int) -> SceneModel:
    """Return the scene with the ``count`` Gaussians that are missed most in the given views, in their old order.

    Args:
        model: the scene.
        views: (camera in the coordinates of the scene, seconds): training frames, which are thinned evenly.
        count: at least 1; a scene that has no more is returned as it is.
    """
    if count >= len(model.gaussians):
        return model
    inner = [(model.similarity.camera(views[k][0]), model.clip_time(views[k][1])) for k in spread(len(views), MAX_VIEWS)]
    gaussians, generator = model.gaussians, torch.Generator().manual_seed(0)
    with spinner("Choosing the Gaussians that are missed most"):
        while len(gaussians) > count:
            changes = sum_contributions(gaussians, inner, generator)
            kept = max(count, int(KEPT_IN_A_ROUND * len(gaussians)))
            rows = torch.argsort(changes, descending=True, stable=True)[:kept].sort().values
            gaussians = gaussians.select(rows)
    return replace(model, gaussians=gaussians)
