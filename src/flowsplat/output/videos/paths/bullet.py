"""A loop round the clip's camera while time stands still."""

from __future__ import annotations

from collections.abc import Sequence

from flowsplat.common.registry import Entry
from flowsplat.geometry import Camera
from flowsplat.output.videos.paths import PATHS, PathRequest, VideoPath
from flowsplat.output.videos.paths.orbit import go_round


def go_round_a_moment(request: PathRequest) -> Sequence[Camera]:
    """Return one turn, as far as the clip has seen enough at that moment."""
    return go_round(request, "bullet time")


BULLET = VideoPath(go_round_a_moment, "bullet_time", stands_still=True, loop_seconds=5)
PATHS.add(Entry("bullet", "Bullet time", "Time standing still, the camera going round.", BULLET, place=40))
