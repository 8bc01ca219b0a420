"""Choose how far videos leave the clip's path: as far as the clip has seen what they show, and knows where objects are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from flowsplat.common.progress import report
from flowsplat.common.spread import spread
from flowsplat.common.threads import in_threads
from flowsplat.gaussians.renderer import PartedRenderer
from flowsplat.gaussians.visibility import ClipVisibility
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath, dolly_zoom, orbit, turn_aside
from flowsplat.output.videos.shots import subject_distance
from flowsplat.priors.objects import load_objects
from flowsplat.priors.objects.areas import large_objects
from flowsplat.scenes import Scene

SWING_ANGLES = (3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0)
"""Degrees to choose from; the first where none is good (docs/method.md, "Evaluation protocols")."""
DOLLY_FACTORS = (1.1, 1.2, 1.3, 1.4, 1.5)
"""Factors of the distance to choose from, likewise (docs/method.md, "Evaluation protocols")."""
MAX_OBJECT_ERROR = 0.02
"""Share of the width of the image by which the largest objects may stand beside their place, by one standard deviation
(docs/method.md, "Evaluation protocols")."""
MAX_UNKNOWN_SHARE = 0.06
"""Share of the image, on average over a loop, that the clip does not tell, beyond what it does not tell of its own views
(docs/method.md, "Evaluation protocols")."""
_PROBE_CAMERAS = 4
"""Cameras of a loop that are looked at: where it turns. Chosen by eye."""
STRETCHES = (1.0, 1.1, 1.2, 1.3, 1.4, 1.5)
"""Times the half-width of the loop to choose from, beyond which dragging in the page cannot pull the camera. Chosen by eye."""
MAX_UNSEEN_SHARE = 0.04
"""Share of any view on the border of what dragging reaches that no frame has seen, at most: .05 is promised, and what is rendered
ends a little beside what is there."""
_DRAG_DIRECTIONS = 8
"""Directions of dragging that are looked at, evenly. Chosen by eye."""
_DRAG_TIMES = 5
"""Times of the clip at which they are. Chosen by eye."""

_Look = tuple[Camera, Camera, float]
"""The clip's camera, the one that is looked by, and the seconds."""


class LoopWidths(NamedTuple):
    """How far the page leaves the clip's cameras; as given here where it is not known how far the clip tells.

    Attributes:
        angle: degrees to either side of loops, half as much up and down; as far the page can be turned and stays there.
        dolly: how many times as far a dolly zoom goes.
        stretch: times ``angle`` as far the page can be pulled, and from where it springs back.
    """

    angle: float = 6.0
    dolly: float = 1.5
    stretch: float = 1.1


class Amplitudes:
    """How far loops round the cameras of a clip and dolly zooms go."""

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
        distance = 1 / self._scene.similarity.scale

        def looks(angle: float) -> list[_Look]:
            return [
                (own, each, t) for t in times for own in [self.path.at(t)] for each in orbit(own, distance, _PROBE_CAMERAS, angle)
            ]

        angles = [angle for angle in SWING_ANGLES if np.radians(angle) * self._astray <= MAX_OBJECT_ERROR] or list(SWING_ANGLES[:1])
        angle, told = self._furthest(angles, looks)
        report(f"{name.capitalize()}: {angle:g} degrees to either side{told}.")
        return angle

    def dolly(self, t: float, distance: float) -> float:
        """Return how many times as far from what is at a planar ``distance`` a dolly zoom goes at ``t`` seconds."""
        own = self.path.at(t)
        factor, told = self._furthest(DOLLY_FACTORS, lambda factor: [(own, dolly_zoom(own, distance, factor), t)])
        report(f"Dolly zoom: {factor:g} times as far{told}.")
        return factor

    def stretch(self, angle: float) -> float:
        """Return how many times ``angle`` (degrees) the camera can be pulled aside at any time, until something is seen that no
        frame has seen."""
        times, distance = self._scene.timestamps, 1 / self._scene.similarity.scale
        probes = [(self.path.at(t), t) for t in (float(times[k]) for k in spread(len(times), _DRAG_TIMES))]
        turns = np.arange(_DRAG_DIRECTIONS) * 2 * np.pi / _DRAG_DIRECTIONS

        def unseen(stretch: float) -> float:
            across, along = stretch * angle * np.cos(turns), stretch * angle / 2 * np.sin(turns)
            views = [
                (turn_aside(own, distance, yaw, pitch), t)
                for own, t in probes
                for yaw, pitch in zip(across.tolist(), along.tolist(), strict=True)
            ]
            return max(in_threads(lambda view: self._visibility.unseen_share(*view), views, self._visibility.threads))

        best, worst = 0, unseen(STRETCHES[0])
        for k in range(1, len(STRETCHES)):
            if (share := unseen(STRETCHES[k])) > MAX_UNSEEN_SHARE:
                break
            best, worst = k, share
        report(f"Dragging: {STRETCHES[best] * angle:.3g} degrees at most, where {worst:.1%} of a view is what no frame has seen.")
        return STRETCHES[best]

    def _furthest(self, values: Sequence[float], looks: Callable[[float], list[_Look]]) -> tuple[float, str]:
        """Return the last of ascending values whose views the clip has seen well enough, the first if none; and what to tell of
        it."""
        # The farther, the less is known: halving finds the last that is good.
        best, beyond = 0, len(values)
        while beyond - best > 1:
            middle = (best + beyond) // 2
            unknown, is_clear = self._measure_unknown(looks(values[middle]))
            best, beyond = (middle, beyond) if is_clear and unknown <= MAX_UNKNOWN_SHARE else (best, middle)
        unknown, is_clear = self._measure_unknown(looks(values[best]))
        return values[best], f"{'' if is_clear else ', close to what moves'}; {unknown:.0%} of what it shows there is a guess"

    def _measure_unknown(self, looks: Sequence[_Look]) -> tuple[float, bool]:
        """Return share of views that the clip does not tell, beyond that of its own, and whether they stay away from objects."""
        visibility = self._visibility
        owns = {t: own for own, _, t in looks}
        views = [*((own, t) for t, own in owns.items()), *((camera, t) for _, camera, t in looks)]
        found = list(in_threads(lambda view: visibility.share(*view), views, visibility.threads))
        least, shares = dict(zip(owns, found, strict=False)), found[len(owns) :]
        beyond = [max(share - least[t], 0.0) for share, (_, _, t) in zip(shares, looks, strict=True)]
        return float(np.mean(beyond)), all(visibility.keeps_clear(camera, own, t) for own, camera, t in looks)

    @cached_property
    def _astray(self) -> float:
        """Share of the width of the image by which the least known of the large objects is astray for each radian."""
        objects = load_objects(self._scene).objects
        large = large_objects(self._scene) if objects else set()
        camera = self._scene.cameras[0]
        return max((obj.sigma for obj in objects if obj.number in large), default=0.0) * camera.K[0, 0] / camera.width

    @cached_property
    def path(self) -> CameraPath:
        """The clip's cameras."""
        return CameraPath(self._scene.timestamps.tolist(), self._scene.cameras)

    @cached_property
    def _visibility(self) -> ClipVisibility:
        return ClipVisibility(self._model, self._scene.cameras, self._scene.timestamps.tolist())


def loop_widths(model: PartedRenderer, scene: Scene) -> LoopWidths:
    """Return how far to go at any time of the clip."""
    amplitudes, times = Amplitudes(model, scene, None), scene.timestamps
    probes = [float(times[k]) for k in spread(len(times), 3)]
    middle = probes[len(probes) // 2]
    subject = subject_distance(model, amplitudes.path.at(middle), middle, 1 / scene.similarity.scale)
    angle, dolly = amplitudes.angle(probes, "swinging camera"), amplitudes.dolly(middle, subject)
    return LoopWidths(angle, dolly, amplitudes.stretch(angle))
