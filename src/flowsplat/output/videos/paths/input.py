"""Along the clip's own cameras."""

from __future__ import annotations

from collections.abc import Sequence

from flowsplat.common.registry import Entry
from flowsplat.geometry import Camera
from flowsplat.output.videos.paths import PATHS, PathRequest, VideoPath


def follow_clip(request: PathRequest) -> Sequence[Camera]:
    """Return the cameras of the clip."""
    return request.own


# The page has the clip's path of its own: everything else there is seen from it.
INPUT = VideoPath(follow_clip, "input_path", is_input=True, is_in_page=False)
PATHS.add(Entry("input", "Of the clip", "Along the clip's own cameras.", INPUT, place=10))
