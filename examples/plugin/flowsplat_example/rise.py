"""Up and down again while time plays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flowsplat.common.registry import Entry
from flowsplat.geometry import Camera
from flowsplat.output.videos.paths import PATHS, PathRequest, VideoPath


def rise(request: PathRequest) -> Sequence[Camera]:
    """Return the clip's cameras, up to a tenth of the median depth above their places."""
    heights = 0.05 * request.distance * (1 - np.cos(request.phases))
    cameras = []
    for own, height in zip(request.own, heights, strict=True):
        viewmat = own.viewmat.copy()
        viewmat[1, 3] += height  # y points down
        cameras.append(replace(own, viewmat=viewmat))
    return cameras


PATHS.add(Entry("rise", "Rise", "Up and down again while time plays.", VideoPath(rise, "rise", loop_seconds=4)))
