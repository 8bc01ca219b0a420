"""Choose how far videos leave the clip's path: as far as the clip has seen what they show, and knows where objects are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
"""Degrees to choose from; the first where none is good (docs/method/evaluation.md)."""
DOLLY_FACTORS = (1.1, 1.2, 1.3, 1.4, 1.5)
"""Factors of the distance to choose from, likewise (docs/method/evaluation.md)."""
MAX_OBJECT_ERROR = 0.02
"""Share of the width of the image by which the largest objects may stand beside their place, by one standard deviation
(docs/method/evaluation.md)."""
MAX_UNKNOWN_SHARE = 0.06
"""Share of the image, on average over a loop, that the clip does not tell, beyond what it does not tell of its own views
(docs/method/evaluation.md)."""
_PROBE_CAMERAS = 4
"""Cameras of a loop that are looked at: where it turns. Chosen by eye."""
MAX_UNSEEN_SHARE = 0.03
"""Share of a view that no frame has seen, at most, as far as the page can be pulled aside; by the truth of the demo it is up to
half as much again (docs/method/evaluation.md)."""
PULL_DIRECTIONS = 8
"""Directions of pulling that are measured, evenly from the left over upwards. Chosen by eye."""
PULL_RANGE = (0.2, 1.15)
"""Times the half-width of the loop that the page can be pulled aside, at least, and at most: as far as the loop goes up and to a
side. Beyond, what frames have seen is bent: the loop is as wide as the clip tells. Chosen by eye."""
_PROBE_TIMES = 3
"""Times of the clip at which the page is measured, evenly. Chosen by eye."""

_Look = tuple[Camera, Camera, float]
"""The clip's camera, the one that is looked by, and the seconds."""


@dataclass(frozen=True)
class Swing:
    """How far a loop round the clip's cameras goes.

    Attributes:
        degrees: to either side, seen from the middle of the scene.
        unknown: share of its views that the clip does not tell, beyond that of its own views.
        holds: whether that is little enough, and nothing that moves is close; where not even the narrowest loop is, it is made all
            the same.
    """

    degrees: float
    unknown: float
    holds: bool


class LoopWidths(NamedTuple):
    """How far the page leaves the clip's cameras; as given here where it is not known how far the clip tells.

    Attributes:
        angle: degrees to either side of loops, half as much up and down.
        dolly: how many times as far a dolly zoom goes.
        pulls: [times][directions] how many times that wide an ellipse may be in which the camera is pulled aside, at even steps of
            the clip and of ``PULL_DIRECTIONS``, but for the loop, which is in reach whatever this says.
    """

    angle: float = 6.0
    dolly: float = 1.5
    pulls: tuple[tuple[float, ...], ...] = ((1.0,) * PULL_DIRECTIONS,)


DEFAULT_WIDTHS = LoopWidths()
"""Where nothing was measured."""


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
        return self._given if self._given is not None else self.measure_swing(times, name).degrees

    def measure_swing(self, times: Sequence[float], name: str) -> Swing:
        """Measure how far a loop at these seconds of the clip may go; ``name`` is what the user is told that it is for."""
        distance = 1 / self._scene.similarity.scale

        def looks(angle: float) -> list[_Look]:
            return [
                (own, each, t) for t in times for own in [self.path.at(t)] for each in orbit(own, distance, _PROBE_CAMERAS, angle)
            ]

        angles = [angle for angle in SWING_ANGLES if np.radians(angle) * self._astray <= MAX_OBJECT_ERROR] or list(SWING_ANGLES[:1])
        angle, unknown, is_clear = self._furthest(angles, looks)
        report(f"{name.capitalize()}: {angle:g} degrees to either side{_tell(unknown, is_clear)}.")
        return Swing(angle, unknown, is_clear and unknown <= MAX_UNKNOWN_SHARE)

    def dolly(self, t: float, distance: float) -> float:
        """Return how many times as far from what is at a planar ``distance`` a dolly zoom goes at ``t`` seconds."""
        own = self.path.at(t)
        factor, unknown, is_clear = self._furthest(DOLLY_FACTORS, lambda factor: [(own, dolly_zoom(own, distance, factor), t)])
        report(f"Dolly zoom: {factor:g} times as far{_tell(unknown, is_clear)}.")
        return factor

    def pulls(self, times: Sequence[float], angle: float) -> tuple[tuple[float, ...], ...]:
        """Return [times][directions] what ``LoopWidths.pulls`` says, for loops of ``angle`` degrees."""
        distance = 1 / self._scene.similarity.scale
        owns = [self.path.at(t) for t in times]
        directions = np.arange(PULL_DIRECTIONS) * 2 * np.pi / PULL_DIRECTIONS

        def unseen(pulls: np.ndarray, which: np.ndarray) -> np.ndarray:
            """Return [n] shares of pulls [times, directions] at some of their places [n, 2]."""
            yaws, pitches = pulls * angle * np.cos(directions), pulls * angle / 2 * np.sin(directions)
            views = [(turn_aside(owns[k], distance, float(yaws[k, d]), float(pitches[k, d])), times[k]) for k, d in which.tolist()]
            return np.array(list(in_threads(lambda view: self._visibility.unseen_share(*view), views, self._visibility.threads)))

        here = np.array([[self._visibility.unseen_share(own, t)] for own, t in zip(owns, times, strict=True)])
        outer = np.full((len(times), PULL_DIRECTIONS), PULL_RANGE[1])
        beyond = unseen(outer, np.argwhere(outer > 0)).reshape(outer.shape)
        # Where it ends is looked for on the line between two shares that are known, and once more from what is seen there.
        inner = np.clip(_place_of(MAX_UNSEEN_SHARE, 0 * outer, outer, here, beyond), *PULL_RANGE)
        found, nearer = beyond.copy(), np.argwhere(inner < outer)
        found[tuple(nearer.T)] = unseen(inner, nearer)
        is_within = found <= MAX_UNSEEN_SHARE
        before = _place_of(MAX_UNSEEN_SHARE, 0 * outer, inner, here, found)
        after = np.where(inner < outer, _place_of(MAX_UNSEEN_SHARE, inner, outer, found, beyond), inner)
        pulls = np.clip(np.where(is_within, after, before), *PULL_RANGE).round(3)
        left, right = pulls[:, 0].min(), pulls[:, PULL_DIRECTIONS // 2].min()
        report(f"Dragging: {angle * left:.3g} degrees straight to the left, {angle * right:.3g} to the right.")
        return tuple(map(tuple, pulls.tolist()))

    def _furthest(self, values: Sequence[float], looks: Callable[[float], list[_Look]]) -> tuple[float, float, bool]:
        """Return the last of ascending values whose views the clip has seen well enough, the first if none, with what
        ``_measure_unknown`` gives for it."""
        # The farther, the less is known: halving finds the last that is good.
        best, beyond = 0, len(values)
        while beyond - best > 1:
            middle = (best + beyond) // 2
            unknown, is_clear = self._measure_unknown(looks(values[middle]))
            best, beyond = (middle, beyond) if is_clear and unknown <= MAX_UNKNOWN_SHARE else (best, middle)
        return values[best], *self._measure_unknown(looks(values[best]))

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


def _tell(unknown: float, is_clear: bool) -> str:
    return f"{'' if is_clear else ', close to what moves'}; {unknown:.0%} of what it shows there is a guess"


def _place_of(value: float, low: np.ndarray, high: np.ndarray, at_low: np.ndarray, at_high: np.ndarray) -> np.ndarray:
    """Return where a line through two values has a third one; far off where it hardly rises."""
    return low + (high - low) * (value - at_low) / np.maximum(at_high - at_low, 1e-6)


def loop_widths(model: PartedRenderer, scene: Scene) -> LoopWidths:
    """Return how far to go at any time of the clip."""
    amplitudes, times = Amplitudes(model, scene, None), scene.timestamps
    probes = [float(times[k]) for k in spread(len(times), _PROBE_TIMES)]
    middle = probes[len(probes) // 2]
    subject = subject_distance(model, amplitudes.path.at(middle), middle, 1 / scene.similarity.scale)
    angle, dolly = amplitudes.angle(probes, "swinging camera"), amplitudes.dolly(middle, subject)
    return LoopWidths(angle, dolly, amplitudes.pulls(probes, angle))
