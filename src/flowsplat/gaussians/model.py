"""A trained 4D scene as a person uses it: cameras of the prepared scene, seconds, plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from flowsplat.gaussians.flow import FlowModel
from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.gaussians.render import fill_uncovered, render
from flowsplat.gaussians.rendering import Part, Rendering
from flowsplat.geometry import Camera, Similarity
from flowsplat.splatting.api import BackendName


@dataclass
class SceneModel:
    """Gaussians together with where and when they are: the internal normalisation of space and time is hidden.

    Attributes:
        gaussians: in normalised coordinates.
        similarity: scene to normalised coordinates.
        first: seconds of the first frame.
        last: seconds of the last frame.
        flow_model: how flow is splatted.
        fill: whether uncovered pixels are filled from their neighbours.
        backend: of the rasterizer.
    """

    gaussians: Gaussians4D
    similarity: Similarity
    first: float
    last: float
    flow_model: FlowModel = "displacement"
    fill: bool = True
    backend: BackendName = "auto"

    def clip_time(self, t: float) -> float:
        """Seconds to clip units."""
        return (t - self.first) / (self.last - self.first)

    def render(self, camera: Camera, t: float, flow_to: tuple[Camera, float] | None = None) -> Rendering:
        """Render the scene: see ``Renderer.render``."""
        other = None if flow_to is None else (self.similarity.camera(flow_to[0]), self.clip_time(flow_to[1]))
        frame = render(
            self.gaussians, self.similarity.camera(camera), self.clip_time(t), flow_to=other, flow_model=self.flow_model,
            backend=self.backend,
        )  # fmt: skip
        alpha = frame.alpha.numpy()
        colour = frame.colour.contiguous().numpy()
        if self.fill:
            colour = fill_uncovered(colour, alpha)
        divisor = np.maximum(alpha, 1e-6)
        return Rendering(
            colour=np.clip(colour, 0, 1),
            alpha=alpha,
            depth=frame.depth.numpy() / divisor / np.float32(self.similarity.scale),
            flow=None if frame.flow is None else frame.flow.numpy() / divisor[..., None],
        )

    def part(self, part: Part) -> SceneModel:
        """A model of the movers alone or of the background alone: see ``PartedRenderer.part``."""
        if part == "all":
            return self
        dynamic = self.gaussians.dynamic
        rows = torch.nonzero(dynamic if part == "movers" else ~dynamic).squeeze(1)
        return replace(self, gaussians=self.gaussians.select(rows), fill=self.fill and part != "movers")

    def active_count(self, t: float) -> int:
        """How many Gaussians are rendered at ``t`` seconds."""
        return len(self.gaussians.active(self.clip_time(t)).rows)
