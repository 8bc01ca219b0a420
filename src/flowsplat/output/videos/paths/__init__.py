"""Camera paths: each a file of this folder, or of another package (entry points ``flowsplat.camera_paths``).

A path gives a camera for every image that it is asked for. Videos, the help, the viewer's list, the titles of reports and the menu
of the page follow from what it registers; none of them names one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from flowsplat.common.registry import Entry, Registry
from flowsplat.common.spread import spread
from flowsplat.gaussians.renderer import PartedRenderer
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath
from flowsplat.output.videos.amplitudes import Amplitudes, Swing
from flowsplat.output.videos.shots import subject_distance


@dataclass(frozen=True)
class PathRequest:
    """What a path is asked for: a camera for each of N images. Cameras and lengths are in the coordinates of the scene.

    Attributes:
        model: what is shown.
        clip: the cameras of the clip at all its times, of the size of the images.
        times: [N] seconds of the clip that the images show, in order; where time stands still, all the same.
        phases: [N] radians from 0 on, the whole way being 2 pi: of loops, which end where they begin.
        step: seconds of the clip between two images where time plays.
        distance: median depth of the scene, by which it is natural to measure.
        stabilize: ``RenderOptions.stabilize``, and so on.
        eye_distance: over ``distance``.
        orbit_angle: degrees; None = not given, as far as ``amplitudes`` say.
        dolly: likewise.
        amplitudes: how far the clip has seen enough; None where ``orbit_angle`` and ``dolly`` are given.
        swings: the loops that were measured for it.
    """

    model: PartedRenderer
    clip: CameraPath
    times: np.ndarray
    phases: np.ndarray
    step: float
    distance: float
    stabilize: float
    eye_distance: float
    orbit_angle: float | None
    dolly: float | None
    amplitudes: Amplitudes | None
    swings: list[Swing] = field(default_factory=list)
    _subjects: dict[float, float] = field(default_factory=dict)

    @cached_property
    def own(self) -> list[Camera]:
        """[N] what the clip's camera is at these times."""
        at = {t: self.clip.at(t) for t in self.moments}
        return [at[t] for t in self.times.tolist()]

    @cached_property
    def moments(self) -> list[float]:
        """The times without repetition."""
        return np.unique(self.times).tolist()

    def subject(self, t: float) -> float:
        """Return planar depth of the objects that the clip's camera sees, ``distance`` where there are none."""
        if t not in self._subjects:
            self._subjects[t] = subject_distance(self.model, self.clip.at(t), t, self.distance)
        return self._subjects[t]

    def choose_angle(self, name: str) -> float:
        """Return the half-width in degrees of a loop round the clip's camera; ``name`` is what the user is told that it is for."""
        if self.orbit_angle is not None:
            return self.orbit_angle
        assert self.amplitudes is not None
        self.swings.append(self.amplitudes.measure_swing([self.moments[k] for k in spread(len(self.moments), 3)], name))
        return self.swings[-1].degrees

    def choose_dolly(self) -> float:
        """Return how many times as far from the subject a dolly zoom goes."""
        if self.dolly is not None:
            return self.dolly
        assert self.amplitudes is not None
        middle = self.moments[len(self.moments) // 2]
        return self.amplitudes.dolly(middle, self.subject(middle))


Cameras = Callable[[PathRequest], Sequence[Camera]]


@dataclass(frozen=True)
class VideoPath:
    """A camera path.

    Attributes:
        cameras: returns a camera for every image of a request.
        file: name of its videos, without suffix.
        stands_still: time does, at ``--render.bullet-time``; otherwise it plays.
        loop_seconds: that one turn takes in the page, which goes on turning while time stands still or plays; None = it is no loop,
            and depends on the time alone.
        frames: of its video, where it is a loop; None = as ``--render.max-frames`` says.
        kind: ``gif``: an animated GIF in color, in place of a video in color, flow and depth and one in color alone.
        is_input: it shows the clip as it came: with its logos and clocks.
        is_in_page: the menu of the page has it.
    """

    cameras: Cameras
    file: str
    stands_still: bool = False
    loop_seconds: float | None = None
    frames: int | None = None
    kind: Literal["panels", "gif"] = "panels"
    is_input: bool = False
    is_in_page: bool = True


class _Paths(Registry[VideoPath]):
    def add(self, entry: Entry[VideoPath]) -> None:
        """Make a path known.

        Raises:
            ValueError: as in any registry, or its videos would have the names of another's.
        """
        if any(other.value.file == entry.value.file for other in self._found.values()):
            raise ValueError(f"there are videos {entry.value.file!r} already.")
        super().add(entry)


PATHS = _Paths("camera path", __name__, "flowsplat.camera_paths")
