"""The slice of 4D Gaussians at a time t: positions, shapes, opacities, colors and velocities, ready to be splatted."""

from flowsplat.gaussians.slicing.api import Gradients, Slice, slice_gaussians

__all__ = ["Gradients", "Slice", "slice_gaussians"]
