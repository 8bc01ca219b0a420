"""Kernels for the features of an image: color, depth and flow."""

from flowsplat.gaussians.flow.cpu.affine import blend_affine
from flowsplat.gaussians.flow.cpu.displacement import blend_displacement

__all__ = ["blend_affine", "blend_displacement"]
