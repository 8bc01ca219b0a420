"""Time stands still, the camera goes back and zooms in, so that the subject stays as large."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flowsplat.common.registry import Entry
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import dolly_zoom
from flowsplat.output.videos.paths import PATHS, PathRequest, VideoPath


def go_back_and_zoom(request: PathRequest) -> Sequence[Camera]:
    """Return one turn there and back."""
    there_and_back = (1 - np.cos(request.phases)) / 2
    factors = request.choose_dolly() ** there_and_back
    views = zip(request.own, request.times.tolist(), factors.tolist(), strict=True)
    return [dolly_zoom(own, request.subject(t), factor) for own, t, factor in views]


SENTENCE = "Back and zoomed in, the subject as large, while time stands still."
DOLLY = VideoPath(go_back_and_zoom, "dolly_zoom", stands_still=True, loop_seconds=6)
PATHS.add(Entry("dolly", "Dolly zoom", SENTENCE, DOLLY, place=50))
