"""What a moving camera does to the image of things that rest."""

from __future__ import annotations

import numpy as np

from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import pixel_grid, unproject_depth


def camera_flow(depth: np.ndarray, camera: Camera, other: Camera) -> np.ndarray:
    """[H, W, 2] flow in pixels that the motion from ``camera`` to ``other`` alone causes on a static scene of this depth."""
    uv, _ = other.project(unproject_depth(depth, camera))
    return uv - pixel_grid(camera.width, camera.height)
