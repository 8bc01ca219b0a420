"""Rank Gaussians by their importance: how much of the images each of them holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from flowsplat.common.progress import track
from flowsplat.common.spread import spread
from flowsplat.gaussians.gaussians4d import NEAR_PLANE, Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.slicing import slice_gaussians
from flowsplat.geometry import Camera
from flowsplat.splatting import blend, project

MAX_VIEWS = 48
"""Training frames that are looked at; more of them change nothing that can be seen."""


def choose_most_important(model: SceneModel, views: Sequence[tuple[Camera, float]], count: int) -> SceneModel:
    """Return the scene with the ``count`` Gaussians that hold most of the given views, in their old order.

    Args:
        model: the scene.
        views: (camera in the coordinates of the scene, seconds): training frames, which are thinned evenly.
        count: at least 1; a scene that has no more is returned as it is.
    """
    if count >= len(model.gaussians):
        return model
    chosen = spread(len(views), MAX_VIEWS)
    inner = [(model.similarity.camera(views[k][0]), model.clip_time(views[k][1])) for k in chosen]
    weights = sum_blending_weights(model.gaussians, inner)
    rows = torch.argsort(weights, descending=True, stable=True)[:count].sort().values
    return replace(model, gaussians=model.gaussians.select(rows))


def sum_blending_weights(gaussians: Gaussians4D, views: Sequence[tuple[Camera, float]]) -> Tensor:
    """Return [N] the sum over views and pixels of p(t) o exp(-d^2 / 2) times the transmittance in front: what a Gaussian adds.

    It is the gradient of the sum of an image with respect to a feature that is 1 everywhere.

    Args:
        gaussians: the model.
        views: (camera in normalized coordinates, clip time).
    """
    total = torch.zeros(len(gaussians))
    for camera, t in track(views, "Weighing the Gaussians"):
        active = gaussians.active(t, camera)
        if not len(active.rows):
            continue
        with torch.no_grad():
            sliced = slice_gaussians(gaussians, active, torch.as_tensor(camera.center, dtype=torch.float32))
            size = camera.width, camera.height
            projected = project(
                sliced.means, sliced.quats, sliced.scales, sliced.opacities, *camera.tensors(), *size, covars=sliced.covars,
                near_plane=NEAR_PLANE,
            )  # fmt: skip
        ones = torch.ones(len(active.rows), 1, requires_grad=True)
        image, _ = blend(projected, sliced.opacities, ones, *size)
        image.sum().backward()
        assert ones.grad is not None
        total.index_add_(0, active.rows, ones.grad[:, 0])
    return total
