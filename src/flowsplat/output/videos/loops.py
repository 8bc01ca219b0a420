"""How wide loops round the clip's camera may be: as far as the clip has seen what they show."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from flowsplat.common.progress import say
from flowsplat.gaussians.renderer import PartedRenderer
from flowsplat.gaussians.support import Support
from flowsplat.geometry.paths import CameraPath, orbit
from flowsplat.scenes import Scene

ANGLES = (3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0)
"""Degrees to choose from; the first where none is good."""
MOST_UNKNOWN = 0.06
"""Share of the picture, on average over a loop, that the clip does not tell, beyond what it does not tell of its own views."""
_PROBES = 4
"""Cameras of a loop that are looked at: where it turns."""


class Loops:
    """The loops round the cameras of a clip."""

    def __init__(self, model: PartedRenderer, scene: Scene, given: float | None):
        """
        Args:
            model: what is shown.
            scene: of the clip.
            given: degrees that were asked for; None = as far as the clip has seen.
        """
        self._model, self._scene, self._given = model, scene, given

    def angle(self, times: Sequence[float], name: str) -> float:
        """Half-width in degrees of a loop at these seconds of the clip; ``name`` is what the user is told that it is for."""
        if self._given is not None:
            return self._given
        # The wider, the less is known: halving finds the widest that is good.
        best, beyond = 0, len(ANGLES)
        while beyond - best > 1:
            middle = (best + beyond) // 2
            unknown, is_clear = self._unknown(ANGLES[middle], times)
            best, beyond = (middle, beyond) if is_clear and unknown <= MOST_UNKNOWN else (best, middle)
        unknown, is_clear = self._unknown(ANGLES[best], times)
        close = "" if is_clear else ", close to what moves"
        angle = ANGLES[best]
        say(f"{name.capitalize()}: {angle:g} degrees to either side{close}; {unknown:.0%} of what it shows there is a guess.")
        return angle

    def _unknown(self, angle: float, times: Sequence[float]) -> tuple[float, bool]:
        """Share of the pictures of a loop that the clip does not tell, and whether it stays away from movers."""
        distance, shares, is_clear = 1 / self._scene.similarity.scale, [], True
        for t in times:
            own = self._path.at(t)
            least = self._support.share(own, t)
            for camera in orbit(own, distance, _PROBES, angle):
                shares.append(max(self._support.share(camera, t) - least, 0.0))
                is_clear = is_clear and self._support.keeps_clear(camera, own, t)
        return float(np.mean(shares)), is_clear

    @cached_property
    def _path(self) -> CameraPath:
        return CameraPath(self._scene.timestamps.tolist(), self._scene.cameras)

    @cached_property
    def _support(self) -> Support:
        return Support(self._model, self._scene.cameras, self._scene.timestamps.tolist())
