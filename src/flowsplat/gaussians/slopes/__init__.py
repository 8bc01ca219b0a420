"""Brightness that varies inside a Gaussian: from slopes along its own axes to slopes in the image."""

from flowsplat.gaussians.slopes.api import image_slopes

__all__ = ["image_slopes"]
