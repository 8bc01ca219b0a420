"""A small swing that shows depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowsplat.common.registry import Entry
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import shift_camera
from flowsplat.output.videos.paths import PATHS, PathRequest, VideoPath
from flowsplat.output.videos.shots import GIF_FPS

WIGGLE_FRAMES = 16
"""Frames of one swing of a wiggle, there and back. Chosen by eye."""


def shift_aside(request: PathRequest) -> Sequence[Camera]:
    """Return one swing to the right, back, to the left and back, by half the distance of the eyes."""
    swing = np.sin(request.phases) * request.eye_distance / 2 * request.distance
    views = zip(request.own, request.times.tolist(), swing.tolist(), strict=True)
    return [shift_camera(own, offset, request.subject(t)) for own, t, offset in views]


WIGGLE = VideoPath(
    shift_aside, "wiggle", stands_still=True, loop_seconds=WIGGLE_FRAMES / GIF_FPS, frames=WIGGLE_FRAMES, kind="gif"
)  # fmt: skip
PATHS.add(Entry("wiggle", "Wiggle", "A small swing that shows depth, as a GIF.", WIGGLE, place=60))
