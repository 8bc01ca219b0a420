"""Who can show a 4D scene, and what a rendered view is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera

Part = str
"""Of a scene: one of ``PARTS``, or ``objects:`` and the numbers of some of them, as in ``objects:2`` or ``objects:1,3``."""
PARTS: tuple[Part, ...] = ("all", "background", "objects")
"""Everything, what is left without the objects, or the objects alone."""


def numbers_of(part: Part) -> tuple[int, ...] | None:
    """The numbers of the objects that a part names; None = it names none.

    Raises:
        InputError: there is no such part.
    """
    if part in PARTS:
        return None
    kind, _, numbers = part.partition(":")
    listed = numbers.split(",")
    if kind != "objects" or not all(number.isdecimal() for number in listed):
        raise InputError(f"Unknown part {part!r}: choose from {', '.join(PARTS)}, or name objects by number as in objects:1,3.")
    return tuple(int(number) for number in listed)


@dataclass(frozen=True)
class Rendering:
    """One rendered view, as NumPy float32 arrays.

    Attributes:
        color: [H, W, 3] sRGB between 0 and 1, uncovered pixels filled from their neighbors.
        alpha: [H, W] how much of the pixel is covered, 0 to 1.
        depth: [H, W] planar depth in the units of the scene's cameras, divided by alpha; 0 where alpha is 0.
        flow: [H, W, 2] pixels, divided by alpha, from this view to the one asked for; None if none was asked for.
    """

    color: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    flow: np.ndarray | None

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        return f"Rendering({width}x{height}{', with flow' if self.flow is not None else ''})"

    def _repr_png_(self) -> bytes:
        """The colors, for notebooks."""
        from flowsplat.images.html import encode  # and OpenCV with it, which rendering alone does not need

        return encode(self.color, quality=None)


class Renderer(Protocol):
    """Anything that can show a 4D scene."""

    def render(self, camera: Camera, t: float, flow_to: tuple[Camera, float] | None = None) -> Rendering:
        """Render the scene at time ``t``.

        Args:
            camera: in the coordinates of the prepared scene's cameras; its size is the image's size.
            t: seconds of the clip.
            flow_to: the other (camera, seconds) that the flow goes to.
        """
        ...


class PartedRenderer(Renderer, Protocol):
    """A renderer that knows what moves."""

    def part(self, part: Part) -> PartedRenderer:
        """The same scene with one part of it only; uncovered pixels of objects alone are not filled but stay black.

        Raises:
            InputError: there is no such part.
        """
        ...

    def at_distances(self, factors: Mapping[int, float], times: Sequence[float], cameras: Sequence[Camera]) -> PartedRenderer:
        """The same scene with some objects farther away, or nearer: see ``gaussians.distances``.

        Args:
            factors: by the number of the object, how many times as far away from the clip's camera as it was trained.
            times: [T] seconds of the clip's frames.
            cameras: [T] its cameras, in the coordinates of the scene.

        Raises:
            InputError: there is no such object, or a factor is none.
        """
        ...

    def fade_by_confidence(self, times: Sequence[float], cameras: Sequence[Camera]) -> PartedRenderer:
        """The same scene in which what the clip tells too little of fades, the further a view is from the clip's own.

        Args:
            times: [T] seconds of the clip's frames.
            cameras: [T] its cameras, in the coordinates of the scene.

        Raises:
            InputError: it is not known what the clip has seen.
        """
        ...
