"""The paths of moving Gaussians through the scene as line segments."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from flowsplat.gaussians.model import SceneModel

_MAX_TRAILS = 300
"""Gaussians whose trails are drawn, at most. Chosen by eye."""
_TRAIL_TIMES = 40
"""Times of the clip at which a trail is looked at. Chosen by eye."""


@torch.no_grad()
def trails(model: SceneModel) -> tuple[np.ndarray, np.ndarray]:
    """Return paths of some moving Gaussians, as far as they are present.

    Returns:
        ends [S, 2, 3] in the units of the scene's cameras and colors [S, 2, 3] uint8 by time, from blue to red; both empty
        where nothing moves.
    """
    gaussians = model.gaussians
    rows = torch.nonzero(gaussians.dynamic).squeeze(1).cpu()
    if len(rows) > _MAX_TRAILS:
        rows = rows[torch.from_numpy(np.random.default_rng(0).choice(len(rows), _MAX_TRAILS, replace=False))]
    if not len(rows):
        return np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)
    params = {name: value[rows] for name, value in gaussians.params.items()}
    times = np.linspace(0, 1, _TRAIL_TIMES).tolist()
    states = [gaussians.motion.state(params, t) for t in times]
    means = [state.means for state in states]
    if model.distances is not None:
        object_ids = gaussians.object_ids[rows]
        means = [model.distances.move(here, object_ids, t) for here, t in zip(means, times, strict=True)]
    places = torch.stack(means).cpu().numpy().astype(np.float64)
    present = torch.stack([state.presence for state in states]).cpu().numpy() >= gaussians.config.p_min
    ends = model.similarity.inverse().points(np.stack([places[:-1], places[1:]], axis=2))
    kept = present[:-1] & present[1:] & np.isfinite(ends).all((2, 3))
    ramp = cv2.applyColorMap(np.linspace(30, 225, _TRAIL_TIMES).astype(np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    colors = np.broadcast_to(np.stack([ramp[:-1], ramp[1:]], axis=1)[:, None], ends.shape)
    return ends[kept].astype(np.float32), colors[kept].astype(np.uint8)
