"""Define the shots of a video, and render the small images that are looked at before."""

from __future__ import annotations

import numpy as np

from flowsplat.gaussians.renderer import PartedRenderer
from flowsplat.geometry import Camera

Shot = tuple[Camera, float]
"""A camera and the seconds of the clip that it shows."""

MIN_ALPHA = 0.5
"""Alpha from which something is shown. Chosen by eye."""
GIF_FPS = 12.5
"""Frames a second of an animated GIF, which counts time in hundredths of a second. Chosen by eye."""
_PROBE_REDUCTION = 4
"""By how much the small images are smaller. Chosen by eye."""


def small(camera: Camera) -> Camera:
    """Return the camera for a small image of what it sees."""
    return camera.resize(max(camera.width // _PROBE_REDUCTION, 1), max(camera.height // _PROBE_REDUCTION, 1))


def subject_distance(model: PartedRenderer, camera: Camera, t: float, otherwise: float) -> float:
    """Return planar depth of the objects that the camera sees, their median; ``otherwise`` where there are none."""
    seen = model.part("objects").render(small(camera), t)
    depth = seen.depth[seen.alpha >= MIN_ALPHA]
    return float(np.median(depth)) if depth.size else otherwise
