"""Who can show a 4D scene, and what a rendered view is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from flowsplat.geometry import Camera

Part = Literal["all", "background", "movers"]
"""Of a scene: everything, what is left without the movers, or the movers alone."""


@dataclass(frozen=True)
class Rendering:
    """One rendered view, as NumPy float32 arrays.

    Attributes:
        colour: [H, W, 3] sRGB between 0 and 1, uncovered pixels filled from their neighbours.
        alpha: [H, W] how much of the pixel is covered, 0 to 1.
        depth: [H, W] planar depth in the units of the scene's cameras, divided by alpha; 0 where alpha is 0.
        flow: [H, W, 2] pixels, divided by alpha, from this view to the one asked for; None if none was asked for.
    """

    colour: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    flow: np.ndarray | None


class Renderer(Protocol):
    """Anything that can show a 4D scene."""

    def render(self, camera: Camera, t: float, flow_to: tuple[Camera, float] | None = None) -> Rendering:
        """Render the scene at time ``t``.

        Args:
            camera: in the coordinates of the prepared scene's cameras; its size is the picture's size.
            t: seconds of the clip.
            flow_to: the other (camera, seconds) that the flow goes to.
        """
        ...


class PartedRenderer(Renderer, Protocol):
    """A renderer that knows what moves."""

    def part(self, part: Part) -> PartedRenderer:
        """The same scene with one part of it only; uncovered pixels of the movers alone are not filled but stay black."""
        ...
