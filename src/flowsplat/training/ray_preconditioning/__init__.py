"""Steps of positions at rest that are longer along their ray."""

from flowsplat.training.ray_preconditioning.api import step_along_rays
from flowsplat.training.ray_preconditioning.reference import HALF_PARALLAX, PathSpread, ray_axes

__all__ = ["HALF_PARALLAX", "PathSpread", "ray_axes", "step_along_rays"]
