"""The distortion of the lens: found with the cameras, and taken out of the images, so that all after it are pinholes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from flowsplat.geometry.cameras import pixel_grid
from flowsplat.priors.cameras.bundle import rays
from flowsplat.priors.cameras.estimate import NEGLIGIBLE_MISFIT, SIMPLER_MISFIT_RATIO, CameraEstimate
from flowsplat.priors.cameras.refinement import from_middle, misfit, refine
from flowsplat.priors.cameras.selection import choose_tracks

TRACKS_PER_CELL = 20
"""About how many tracks of a cell of the image tell the distortion. Chosen by eye."""
MIN_DISTORTION_SIGMAS = 3.0
"""Standard deviations by which the distortion must differ from none to be taken out (docs/method.md, "Cameras")."""
MIN_LENS_SLOPE = 0.1
"""How fast a point of the straightened image must at least leave the middle of the one it is taken from. Chosen by eye."""
MIN_BORDER_SHIFT = 0.3
"""Pixels of the border below which a distortion is not worth resampling the images for (docs/method.md, "Cameras")."""


@dataclass(frozen=True)
class Lens:
    """A radial lens and the pinhole that sees the part of its image that has no blank border.

    Attributes:
        focal: pixels of the images as they came.
        distortion: k1 of x_d = x (1 + k1 |x|^2), x = (X/Z, Y/Z); OpenCV's and COLMAP's.
        pinhole: focal length in pixels of the straightened images.
        width, height: pixels.
    """

    focal: float
    distortion: float
    pinhole: float
    width: float
    height: float

    @staticmethod
    def of(focal: float, distortion: float, width: float, height: float) -> Lens:
        """With the shortest focal length whose image lies within the distorted one."""
        border = _border(width, height)
        low, high = 0.25 * focal, 4.0 * focal
        for _ in range(50):
            middle = (low + high) / 2
            x = border / middle
            inside = (np.abs(_bend(x, distortion) * focal) <= np.array([width, height]) / 2).all()
            # Where a strong barrel would fold back, a point of the image has no place of its own.
            unfolded = (1 + 3 * distortion * (x**2).sum(-1) > MIN_LENS_SLOPE).all()
            low, high = (low, middle) if inside and unfolded else (middle, high)
        return Lens(focal, distortion, high, width, height)

    def scale(self, factor: float) -> Lens:
        """Return the same for images that are larger by ``factor``."""
        return Lens(self.focal * factor, self.distortion, self.pinhole * factor, self.width * factor, self.height * factor)

    @property
    def shift(self) -> float:
        """Pixels by which the lens moves a point of the border, at most."""
        border = _border(self.width, self.height) / self.focal
        return float(np.linalg.norm(_bend(border, self.distortion) - border, axis=1).max() * self.focal)

    def straighten_positions(self, positions: np.ndarray) -> np.ndarray:
        """Return tracks [..., 2] in pixels of the images as they came, as they lie in the straightened ones; NaN stays."""
        middle = np.array([self.width, self.height]) / 2
        return rays(positions - middle, self.focal, self.distortion) * self.pinhole + middle

    def straighten(self, image: np.ndarray) -> np.ndarray:
        """Return an image [H, W, 3] as the pinhole sees it; object numbers [H, W] stay what they are."""
        middle = np.array([self.width, self.height]) / 2
        grid = (pixel_grid(round(self.width), round(self.height)) - middle) / self.pinhole
        source = (_bend(grid, self.distortion) * self.focal + middle - 0.5).astype(np.float32)
        method = cv2.INTER_NEAREST if image.ndim == 2 else cv2.INTER_CUBIC
        return cv2.remap(image, source, None, method, borderMode=cv2.BORDER_REPLICATE)

    def to_json(self) -> dict[str, Any]:
        """Plain numbers."""
        return {name: float(value) for name, value in vars(self).items()}


def _bend(x: np.ndarray, distortion: float) -> np.ndarray:
    return x * (1 + distortion * (x**2).sum(-1, keepdims=True))


def _border(width: float, height: float) -> np.ndarray:
    """Return points [N, 2] of the image's border, from its middle."""
    side = np.linspace(-0.5, 0.5, 33)
    edge = np.concatenate([np.stack([side, 0 * side + end], 1) for end in (-0.5, 0.5)])
    return np.concatenate([edge, edge[:, ::-1]]) * [width, height]


def find_lens(
    positions: np.ndarray, width: float, height: float, focal: float | None, found: CameraEstimate, start: Lens | None
) -> Lens | None:
    """Return the lens that the cameras of ``found`` leave to be explained; None where there is none, or where it does not show.

    Args:
        positions: [N, T, 2] pixels as they came, NaN where not seen.
        focal: pixels, where it is known.
        found: cameras of the same frames.
        start: the lens that was taken out before these were found.
    """
    if found.motion not in ("free", "rotation"):
        return None
    seen = np.isfinite(positions[..., 0])
    chosen = choose_tracks(positions, seen, width, height, TRACKS_PER_CELL)
    if len(chosen) == 0:
        return None
    seen = seen[chosen]
    centered = from_middle(positions[chosen], seen, width, height)
    state = found.fit.state
    if start is not None:
        state = replace(state, focal=state.focal * start.focal / start.pinhole, distortion=start.distortion)
    known = partial(refine, fixed_camera=0, expected_focal=focal or state.focal, free_focal=focal is None, free_distortion=True)
    # A lens that bends a turning camera's images looks like a camera that moves, so both are asked.
    turned = replace(state, translations=np.zeros_like(state.translations))
    fit = known(turned, centered, seen, free_translations=False)
    if found.motion == "free":
        moved = known(state, centered, seen)
        turning, moving = misfit(fit.state, centered, seen, free_translations=False), misfit(moved.state, centered, seen)
        fit = fit if turning + NEGLIGIBLE_MISFIT <= SIMPLER_MISFIT_RATIO * (moving + NEGLIGIBLE_MISFIT) else moved
    lens = Lens.of(fit.state.focal, fit.state.distortion, width, height)
    clear = abs(lens.distortion) > MIN_DISTORTION_SIGMAS * fit.distortion_sigma and lens.shift > MIN_BORDER_SHIFT
    return lens if clear else None
