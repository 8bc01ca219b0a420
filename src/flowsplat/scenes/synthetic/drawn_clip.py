"""Define a drawn clip with its truth, and its views from aside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.geometry import Camera
from flowsplat.scenes.layers import Flow, Tracks
from flowsplat.scenes.scene import HeldoutView

VIEW_STEP = 4
"""Held-out views exist at every fourth time."""

HELD_OUT_BASELINE = 0.06
"""Held-out cameras stand this share of the scene's depth to the left and to the right, and turn in by as much. Chosen by eye."""


@dataclass(frozen=True)
class DrawnView:
    """One rendered view.

    Attributes:
        image: [H, W, 3] uint8 RGB, antialiased.
        depth: [H, W] float64 planar depth in meters at the pixel centers.
        mask: [H, W] uint8, number of the object at the pixel center, 0 = static.
    """

    image: np.ndarray
    depth: np.ndarray
    mask: np.ndarray


class DrawnClip(Protocol):
    """A clip of a world in which everything is known exactly. Same parameters, same bits; meters, seconds, world z up."""

    @property
    def width(self) -> int:
        """Pixels."""

    @property
    def height(self) -> int:
        """Pixels."""

    @property
    def frames(self) -> int:
        """How many."""

    @property
    def fps(self) -> float:
        """Frames a second."""

    @property
    def timestamps(self) -> np.ndarray:
        """[T] float64 seconds."""

    def camera(self, i: int) -> Camera:
        """Return the camera of frame ``i``."""

    def render(self, camera: Camera, time: float) -> DrawnView:
        """Return the world at ``time`` (seconds) from any camera in it."""

    def flow(self, i: int, j: int) -> Flow:
        """Return the flow from frame ``i`` to frame ``j``; its confidence is 1 where the point is visible in ``j``, else 0."""

    def tracks(self) -> Tracks:
        """Return world points over the whole clip, on what moves and on what rests."""

    def heldout_views(self) -> list[HeldoutView]:
        """Return cameras beside the clip's own."""

    def covisible(self, view: HeldoutView) -> np.ndarray:
        """Return [H, W] bool: pixels of a held-out view whose point the clip's frame of the same time sees, too."""


def views_aside(camera: Callable[[int], Camera], frames: int, depth: float) -> list[HeldoutView]:
    """Return a camera to the left and one to the right of the clip's own, at every ``VIEW_STEP``-th frame.

    Args:
        camera: of a frame.
        frames: how many.
        depth: meters from the camera to the middle of the scene, about.
    """
    views = []
    for i in range(0, frames, VIEW_STEP):
        own = camera(i)
        for name, side in (("left", -HELD_OUT_BASELINE), ("right", HELD_OUT_BASELINE)):
            step = np.eye(4)
            step[0, 3] = -side * depth
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_euler("y", np.arctan(side)).as_matrix()
            views.append(HeldoutView(f"{name}_{i:05d}", i, Camera(turn @ step @ own.viewmat, own.K, own.width, own.height)))
    return views
