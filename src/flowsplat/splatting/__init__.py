"""Differentiable rasterization of 3D Gaussians with any number of feature channels. Knows nothing of time or video."""

from flowsplat.splatting.api import Projected, blend, project, rasterize
from flowsplat.splatting.gsplat_api import rasterization

__all__ = ["Projected", "blend", "project", "rasterization", "rasterize"]
