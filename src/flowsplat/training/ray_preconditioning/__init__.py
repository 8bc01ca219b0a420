"""Steps of positions at rest that are longer along their ray."""

from flowsplat.training.ray_preconditioning.api import step_along_rays
from flowsplat.training.ray_preconditioning.reference import FEWEST_PIXELS, PathSpread, ray_axes

__all__ = ["FEWEST_PIXELS", "PathSpread", "ray_axes", "step_along_rays"]
