"""The distortion of the lens, found with the cameras."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from flowsplat.geometry.lens import Distortion, Lens
from flowsplat.priors.cameras.estimate import NEGLIGIBLE_MISFIT, SIMPLER_MISFIT_RATIO, CameraEstimate
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.refinement import misfit, refine
from flowsplat.priors.cameras.selection import choose_tracks

TRACKS_PER_CELL = 20
"""About how many tracks of a cell of the image tell the distortion. Chosen by eye."""
MIN_DISTORTION_SIGMAS = 3.0
"""Standard deviations by which the distortion must differ from none to be taken out (docs/method/cameras.md)."""
MIN_BORDER_SHIFT = 0.3
"""Pixels of the border below which a distortion is not worth resampling the images for (docs/method/cameras.md)."""


def radial_lens(focal: float, k1: float, width: float, height: float) -> Lens:
    """Return the lens of x_d = x (1 + k1 |x|^2), x = (X/Z, Y/Z), in the middle of images of this size; OpenCV's and COLMAP's.

    Raises:
        ValueError: there is no pinhole for it.
    """
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Lens.of(K, Distortion((k1, 0.0, 0.0, 0.0)), width, height)


def find_lens(
    seen: Observations, width: float, height: float, focal: float | None, found: CameraEstimate, start: Lens | None
) -> Lens | None:
    """Return the lens that the cameras of ``found`` leave to be explained; None where there is none, or where it does not show.

    Args:
        seen: in pixels of the frames as they came.
        focal: pixels, where it is known.
        found: cameras of the same frames.
        start: the lens that was taken out before these were found.
    """
    if found.motion not in ("free", "rotation"):
        return None
    chosen = choose_tracks(seen, width, height, TRACKS_PER_CELL)
    if len(chosen) == 0:
        return None
    centered = seen.of_points(chosen).from_middle(width, height)
    state = found.fit.state
    if start is not None:
        state = replace(state, focal=state.focal / start.zoom, distortion=start.distortion.coefficients[0])
    known = partial(refine, fixed_camera=0, expected_focal=focal or state.focal, free_focal=focal is None, free_distortion=True)
    # A lens that bends a turning camera's images looks like a camera that moves, so both are asked.
    turned = replace(state, translations=np.zeros_like(state.translations))
    fit = known(turned, centered, free_translations=False)
    if found.motion == "free":
        moved = known(state, centered)
        turning, moving = misfit(fit.state, centered, free_translations=False), misfit(moved.state, centered)
        fit = fit if turning + NEGLIGIBLE_MISFIT <= SIMPLER_MISFIT_RATIO * (moving + NEGLIGIBLE_MISFIT) else moved
    try:
        lens = radial_lens(fit.state.focal, fit.state.distortion, width, height)
    except ValueError:
        return None
    clear = abs(fit.state.distortion) > MIN_DISTORTION_SIGMAS * fit.distortion_sigma and lens.shift > MIN_BORDER_SHIFT
    return lens if clear else None
