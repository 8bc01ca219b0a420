"""A camera path in the making: keys that a client sets, and the shots between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath
from flowsplat.output.videos.shots import Shot


class CameraKeys:
    """Cameras with the time of the clip that each shows, at even steps of the video."""

    def __init__(self, spacing: float = 1.0):
        """``spacing``: seconds of the video from one key to the next."""
        self.spacing = spacing
        self.keys: list[Shot] = []
        self._is_whole = False

    @staticmethod
    def of_shots(shots: Sequence[Shot], fps: float) -> CameraKeys:
        """Return a path that was read from a file: every shot is a key."""
        found = CameraKeys(1 / fps)
        found.keys = list(shots)
        found._is_whole = True
        return found

    def add(self, camera: Camera, t: float) -> None:
        """Set the next key.

        Raises:
            InputError: the path came as a whole, with a key for every frame and a size of its own.
        """
        if self._is_whole:
            raise InputError("This path has a key for every frame already: clear it to make one of your own.")
        self.keys.append((camera, t))

    @property
    def seconds(self) -> float:
        """How long the video is."""
        return max(len(self.keys) - 1, 0) * self.spacing

    def shot_at(self) -> Callable[[float], Shot]:
        """Return a function that tells, after so many seconds of the video, where the camera is and which time of the clip it
        shows."""
        steps, times = np.arange(len(self.keys)) * self.spacing, [t for _, t in self.keys]
        path = CameraPath(steps.tolist(), [camera for camera, _ in self.keys])
        return lambda seconds: (path.at(seconds), float(np.interp(seconds, steps, times)))

    def shots(self, fps: float) -> list[Shot]:
        """Return one shot a frame of the video; none without keys."""
        if not self.keys:
            return []
        shot_at = self.shot_at()
        return [shot_at(k / fps) for k in range(int(self.seconds * fps + 1e-6) + 1)]
