"""The street of the demo as a clip: what people film, with everything known exactly."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.scenes.layers import Flow, Tracks
from flowsplat.scenes.scene import HeldoutView
from flowsplat.scenes.synthetic.drawn_clip import DrawnView, views_aside
from flowsplat.scenes.synthetic.worlds.street import MIDDLE, draw_street, frame_rate
from flowsplat.scenes.synthetic.worlds.world import World

STREET_SEED = 3
"""Of ten, 0 to 9, the median by the PSNR of held-out views with priors of our own (the lower of the two in the middle)."""


@dataclass(frozen=True)
class StreetScene:
    """A street with three objects: 1 = someone who walks, 2 = a cart, 3 = a ball that bounces.

    Fewer frames show less of the same motion; more than three seconds show the same three seconds in more frames. Same
    parameters, same bits.

    Attributes:
        width: pixels.
        height: pixels.
        frames: how many.
        seed: decides where everything is, how it moves and its colors.

    Raises:
        InputError: a parameter that makes no clip.
    """

    width: int = 320
    height: int = 180
    frames: int = 40
    seed: int = STREET_SEED

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 32:
            raise InputError(f"A clip of the street of {self.width}x{self.height} pixels is too small: use at least 32x32.")
        if self.frames < 2 or self.seed < 0:
            raise InputError(
                f"A clip of the street of seed {self.seed} with {self.frames} frame(s) shows no motion: use at least 2 frames "
                "and a seed of 0 or more."
            )

    @cached_property
    def world(self) -> World:
        """Everything there is."""
        return draw_street(self.seed, self.width, self.height, self.frames)

    @property
    def fps(self) -> float:
        """Frames a second."""
        return frame_rate(self.frames)

    @property
    def timestamps(self) -> np.ndarray:
        """[T] float64 seconds."""
        return np.arange(self.frames) / self.fps

    def camera(self, i: int) -> Camera:
        """Return the camera of frame ``i``, meters, world z up."""
        return self.world.camera(i)

    def render(self, camera: Camera, time: float) -> DrawnView:
        """Return the street at ``time`` (seconds) from any camera in it, with the noise of that time."""
        rng = np.random.default_rng([self.seed, 7, round(1e6 * time)])
        depth, mask = self.world.cast_rays(camera, time)
        return DrawnView(self.world.photograph(lambda _: camera, time, rng), depth, mask)

    def flow(self, i: int, j: int) -> Flow:
        """Return the flow from frame ``i`` to frame ``j``; its confidence is 1 where the point is visible in ``j``, else 0."""
        return self.world.flow(i, j)

    def tracks(self) -> Tracks:
        """Return world points over the whole clip, a hundred on each object and twice as many on what rests."""
        return self.world.tracks()

    def heldout_views(self) -> list[HeldoutView]:
        """Return a camera to the left and one to the right of the clip's own, at every fourth frame."""
        return views_aside(self.camera, self.frames, float(MIDDLE[1]))

    def covisible(self, view: HeldoutView) -> np.ndarray:
        """Return [H, W] bool: pixels of a held-out view whose point the clip's frame of the same time sees, too."""
        return self.world.covisible(view)
