"""The slice of 4D Gaussians at a time t: positions, shapes, opacities, colours and velocities, ready to be splatted."""

from flowsplat.gaussians.slicing.api import Slice, slice_gaussians

__all__ = ["Slice", "slice_gaussians"]
