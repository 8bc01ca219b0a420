"""A loop round the clip's camera while time plays."""

from __future__ import annotations

from collections.abc import Sequence

from flowsplat.common.registry import Entry
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import move_on_orbit
from flowsplat.output.videos.paths import PATHS, PathRequest, VideoPath


def go_round(request: PathRequest, name: str = "orbit") -> Sequence[Camera]:
    """Return one turn, as far as the clip has seen enough."""
    angle = request.choose_angle(name)
    return [move_on_orbit(own, request.distance, p, angle) for own, p in zip(request.own, request.phases, strict=True)]


# In the page it is bullet time that plays.
ORBIT = VideoPath(go_round, "orbit", loop_seconds=5, is_in_page=False)
PATHS.add(Entry("orbit", "Orbit", "Round the middle of the clip.", ORBIT, place=30))
