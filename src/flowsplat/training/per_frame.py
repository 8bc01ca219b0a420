"""Fit one static scene to every training frame, to compare with: what 3D Gaussians do that know nothing of time.

All sets together have the Gaussians and the frame-steps that a moving scene has. A time in between is shown by the set of the
nearest training frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.observations import Observations
from flowsplat.gaussians.renderer import Rendering
from flowsplat.geometry import Camera
from flowsplat.training.config import TrainConfig
from flowsplat.training.static import static_config
from flowsplat.training.trainer import Trainer


@dataclass(frozen=True)
class PerFrameModel:
    """Static scenes, each of one time.

    Attributes:
        models: one for every time.
        seconds: [T] rising, seconds of the clip.
    """

    models: Sequence[SceneModel]
    seconds: np.ndarray

    def nearest(self, t: float) -> SceneModel:
        """Return the scene of the time nearest to ``t`` seconds, the earlier one of two."""
        return self.models[int(np.abs(self.seconds - t).argmin())]

    def render(self, camera: Camera, t: float, flow_to: tuple[Camera, float] | None = None) -> Rendering:
        """Render the nearest scene: see ``Renderer.render``. Its flow is that of the camera alone."""
        return self.nearest(t).render(camera, t, flow_to)

    def active_count(self, t: float) -> int:
        """Return how many Gaussians are rendered at ``t`` seconds."""
        return self.nearest(t).active_count(t)


def per_frame_config(config: TrainConfig, frames: int) -> TrainConfig:
    """Return the settings of one frame's set: its share of the Gaussians and of the steps, and nothing that depends on time."""
    still = static_config(config)
    return replace(
        still,
        iterations=max(1, config.iterations * (config.frames_per_iteration or frames) // frames),
        frames_per_iteration=1,
        preview_every=0,
        model=replace(still.model, gains=0),
        density=replace(still.density, max_gaussians=max(1, still.density.max_gaussians // frames)),
    )


def train_per_frame(observations: Observations, config: TrainConfig, device: torch.device | str = "cpu") -> list[Gaussians4D]:
    """Train one set of static Gaussians on every training frame, objects and background alike."""
    share = per_frame_config(config, len(observations))
    found = []
    for frame in observations.frames:
        still = replace(frame, object_ids=np.zeros_like(frame.object_ids), forward=None, backward=None)
        found.append(Trainer(Observations([still], observations.similarity), None, share, device=device).run())
    return found
