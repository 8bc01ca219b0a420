"""Triton kernels for the features of an image: color, depth and flow."""

from flowsplat.gaussians.flow.triton.affine import blend_affine
from flowsplat.gaussians.flow.triton.displacement import blend_displacement

__all__ = ["blend_affine", "blend_displacement"]
