"""Cameras, projection, rotations, similarities, interpolation. All is OpenCV axes, pixel centers at +0.5, quaternions wxyz."""

from flowsplat.geometry.cameras import Camera
from flowsplat.geometry.similarity import Similarity

__all__ = ["Camera", "Similarity"]
