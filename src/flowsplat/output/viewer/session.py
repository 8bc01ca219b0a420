"""Keep the state of a client: what it looks at, and which image it needs next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from flowsplat.output.viewer.browser_frame import Pose
from flowsplat.output.viewer.clock import PlaybackClock
from flowsplat.output.viewer.drawing import Look, Wish
from flowsplat.output.viewer.resolution import AdaptiveResolution

Mode = Literal["orbit", "fly", "input camera"]

_SETTLE_SECONDS = 0.25
"""Seconds without a change after which an image counts as still. Chosen by eye."""
_MAX_FPS = 30
"""Images a second that are drawn while something moves, at most. Chosen by eye."""


@dataclass(frozen=True)
class ImageJob:
    """An image to be made: what it shows, and whether it is the final one or one of a moving sequence."""

    wish: Wish
    is_still: bool
    version: tuple[int, int]


class Session:
    """The state of a client; it is only touched under the lock of the worker."""

    def __init__(self, clip: tuple[float, float], largest: int):
        self.clock, self.resolution = PlaybackClock(*clip), AdaptiveResolution(largest)
        self.mode: Mode = "input camera"
        self.turn = (0.0, 0.0)
        """Degrees to the left and up that the input camera is looked past."""
        self.look = Look()
        self.pose: Pose | None = None
        self.canvas: tuple[int, int] | None = None
        self.is_held = False
        """Something else is shown to the client, such as a path."""
        self._version, self._changed = 0, float("-inf")
        self._drawn: tuple[tuple[int, int], float, bool] | None = None
        self._drawn_at = float("-inf")

    def change(self, now: float) -> None:
        """Something that is seen was changed."""
        self._version += 1
        self._changed = now

    def move(self, pose: Pose, canvas: tuple[int, int], now: float) -> None:
        """The client's camera or window changed; while it looks through the input camera, its own camera does not count."""
        seen_alike = self.mode == "input camera" and canvas == self.canvas
        self.pose, self.canvas = pose, canvas
        if not seen_alike:
            self.change(now)

    def job(self, now: float, model: int) -> ImageJob | None:
        """Return what is to be made for this client at this moment, if anything.

        Args:
            model: number of the model's state.
        """
        if self.is_held or self.canvas is None or min(self.canvas) < 1:
            return None
        t = self.clock.at(now)
        is_still = not self.clock.playing and now - self._changed >= _SETTLE_SECONDS
        version = (self._version, model)
        if self._drawn is not None:
            drawn_version, drawn_t, was_still = self._drawn
            if drawn_version == version and drawn_t == t and (was_still or not is_still):
                return None
            if not is_still and now - self._drawn_at < 1 / _MAX_FPS:
                return None
        size = self.resolution.still(self.canvas) if is_still else self.resolution.choose_moving_size(self.canvas)
        where = (None, self.turn) if self.mode == "input camera" else (self.pose,)
        return ImageJob(Wish(size, t, self.look, *where), is_still, version)

    def is_restless(self, now: float) -> bool:
        """Return whether it will need an image soon without anything more being changed."""
        return self.clock.playing or now - self._changed < 2 * _SETTLE_SECONDS

    def finish_image(self, job: ImageJob, now: float, seconds: float) -> None:
        """An image was made, and took so long."""
        self._drawn, self._drawn_at = (job.version, job.wish.t, job.is_still), now
        if not job.is_still:
            self.resolution.learn(job.wish.size, seconds)
