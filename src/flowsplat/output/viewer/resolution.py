"""Adapt the resolution of rendered images: all of it when still, as much as can be drawn fluently while something moves."""

from __future__ import annotations

_TARGET_SECONDS = 0.08
"""Seconds that an image may take while something moves. Chosen by eye."""
_MIN_MOVING_SIDE = 240
"""Pixels of the longer side. Chosen by eye."""


class AdaptiveResolution:
    """Learns from the times of past images how large the next one may be."""

    def __init__(self, largest: int):
        """``largest``: pixels of the longer side of a still image."""
        self._largest = largest
        self._pixels = 100_000.0

    def still(self, canvas: tuple[int, int]) -> tuple[int, int]:
        """Return (width, height) of a still image for a canvas of that size."""
        return _scale(canvas, min(1.0, self._largest / max(canvas)))

    def choose_moving_size(self, canvas: tuple[int, int]) -> tuple[int, int]:
        """Return (width, height) of an image that is fluent; never more than a still one."""
        width, height = self.still(canvas)
        scale = min((self._pixels / (width * height)) ** 0.5, 1.0)
        return _scale((width, height), max(scale, min(_MIN_MOVING_SIDE / max(width, height), 1.0)))

    def learn(self, size: tuple[int, int], seconds: float) -> None:
        """A moving image of that size took so long."""
        wish = size[0] * size[1] * min(max(_TARGET_SECONDS / max(seconds, 1e-4), 0.4), 1.6)
        # Half of the way: one slow image (the first one compiles) must not spoil the next ones.
        self._pixels = (self._pixels * wish) ** 0.5


def _scale(size: tuple[int, int], scale: float) -> tuple[int, int]:
    return max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)
