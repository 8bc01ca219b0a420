"""Along the clip's own cameras, without the shaking."""

from __future__ import annotations

from collections.abc import Sequence

from flowsplat.common.progress import report
from flowsplat.common.registry import Entry
from flowsplat.geometry import Camera
from flowsplat.output.videos.paths import PATHS, PathRequest, VideoPath
from flowsplat.output.videos.stabilized import stabilize


def follow_steadily(request: PathRequest) -> Sequence[Camera]:
    """Return the clip's cameras smoothed and cropped."""
    along = list(zip(request.own, request.times.tolist(), strict=True))
    shots, share = stabilize(request.model, along, request.stabilize / request.step)
    report(f"The stabilized path shows {share:.0%} of the width and height of the clip.")
    return [camera for camera, _ in shots]


SENTENCE = "Along the clip's own cameras, without the shaking."
PATHS.add(Entry("stabilized", "Steadied", SENTENCE, VideoPath(follow_steadily, "stabilized"), place=20))
