"""Keep the state of a client: what it looks at, and which image it needs next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from flowsplat.output.viewer.browser_frame import Pose
from flowsplat.output.viewer.clock import PlaybackClock
from flowsplat.output.viewer.drawing import Look, Wish
from flowsplat.output.viewer.elastic import STILL_SECONDS, ElasticTurn
from flowsplat.output.viewer.resolution import AdaptiveResolution

Mode = Literal["orbit", "fly", "input camera"]

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
        self.elastic = ElasticTurn()
        """How far the input camera is looked past."""
        self.look = Look()
        self.pose: Pose | None = None
        self.canvas: tuple[int, int] | None = None
        self.is_held = False
        """Something else is shown to the client, such as a path."""
        self._version, self._changed = 0, float("-inf")
        self._drawn: tuple[Wish, tuple[int, int], bool] | None = None
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

    def view(self, now: float) -> tuple[Pose | None, tuple[float, float]]:
        """Return where the client looks from, as ``Wish`` has it: a pose, or None and a turn of the input camera."""
        return (None, self.elastic.turn(now)) if self.mode == "input camera" else (self.pose, (0.0, 0.0))

    def job(self, now: float, model: int) -> ImageJob | None:
        """Return what is to be made for this client at this moment, if anything.

        Args:
            model: number of the model's state.
        """
        if self.is_held or self.canvas is None or min(self.canvas) < 1:
            return None
        t = self.clock.at(now)
        pose, turn = self.view(now)
        is_turning = pose is None and self.elastic.is_moving(now)
        is_still = not self.clock.playing and not is_turning and now - self._changed >= STILL_SECONDS
        version = (self._version, model)
        if self._drawn is not None:
            drawn, drawn_version, was_still = self._drawn
            if drawn_version == version and (drawn.t, drawn.turn) == (t, turn) and (was_still or not is_still):
                return None
            if not is_still and now - self._drawn_at < 1 / _MAX_FPS:
                return None
        size = self.resolution.still(self.canvas) if is_still else self.resolution.choose_moving_size(self.canvas)
        return ImageJob(Wish(size, t, self.look, pose, turn), is_still, version)

    def is_restless(self, now: float) -> bool:
        """Return whether it will need an image soon without anything more being changed."""
        is_turning = self.mode == "input camera" and self.elastic.is_moving(now)
        return self.clock.playing or is_turning or now - self._changed < 2 * STILL_SECONDS

    def finish_image(self, job: ImageJob, now: float, seconds: float) -> None:
        """An image was made, and took so long."""
        self._drawn, self._drawn_at = (job.wish, job.version, job.is_still), now
        if not job.is_still:
            self.resolution.learn(job.wish.size, seconds)
