"""What a video is made of, and the small images in which is looked before it is rendered."""

from __future__ import annotations

from flowsplat.geometry import Camera

Shot = tuple[Camera, float]
"""A camera and the seconds of the clip that it shows."""

COVERED = 0.5
"""Alpha from which something is shown."""
_PROBE_SHARE = 4
"""By how much the small images are smaller."""


def small(camera: Camera) -> Camera:
    """The camera for a small image of what it sees."""
    return camera.resize(max(camera.width // _PROBE_SHARE, 1), max(camera.height // _PROBE_SHARE, 1))
