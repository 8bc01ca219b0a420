"""What monocular depth says of the distance of objects, and how wrong it is where the scene rests.

It is fitted to the static scene frame by frame (``MonocularMaps``). How wrong it is then is measured on what rests, over areas as
large as an object: their mean error is the standard deviation of the cue, and it does not get smaller over time, for what a network
takes for nearer than it is stays so. The error of what surrounds an object is not taken off: its own may be another. To this comes
what scale and shift leave open where an object is nearer than most of what rests: before a bare wall they cannot be told apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.geometry import Camera
from flowsplat.priors.background.monocular_maps import (
    MAX_FIT_SAMPLES,
    METRIC_SHIFT_SIGMA,
    MIN_STATIC_PIXELS,
    RELATIVE_SHIFT_SIGMA,
    MonocularMaps,
    fit_line,
)
from flowsplat.priors.background.static_depth import MAX_DEPTH, MIN_DEPTH, SURE_WEIGHT, Background
from flowsplat.priors.objects.contact import middle_of, upright_ratio
from flowsplat.priors.objects.distance import Cue
from flowsplat.priors.objects.shape_offset import roundness
from flowsplat.scenes.layers import TRUSTED_CONFIDENCE

MONOCULAR_ERROR_RATE = 0.1
"""Chance that monocular depth of an object has nothing to do with it, though that of what rests is right. Chosen by eye."""
ERROR_RATIO = 1.5
"""Error of what moves over that of what rests, to which the source is fitted. Chosen between stand-ins of 4 and 8 % (1.4 and 1.7,
on workshop and two worlds below 900) and two poor networks (2.4 and 2.6, on workshop; docs/notebook/2026-11.md, "Monocular depth as
a cue")."""
RIM = 2
"""Pixels of an object's rim that are left out: networks blur it. Chosen by eye."""
MIN_COVERAGE = 0.5
"""Share of an area in which depth must be measured. Chosen by eye."""
MIN_SHARED_VARIANCE = 0.5
"""Squared correlation of monocular and measured inverse depth from which the shift of a source that does not know it is told by
what rests. Chosen by eye."""
MIN_AREAS = 30
"""Areas that rest, over all frames, from which the error counts as known. Chosen by eye."""
INDEPENDENT_FRAMES = 10
"""Frames in a row whose errors count as one. Chosen by eye."""
_STATISTICS_FRAMES = 16
"""Frames in which the error is measured, at most, for the time. A round number."""


@dataclass
class Told:
    """What was seen of one object.

    Attributes:
        log_depth: [T] of its middle by monocular depth, NaN where nothing is said.
        shift_error: [T] error of that in ln that an error of the shift leads to, as large as it may be.
        errors: mean error in ln depth of areas that rest and are as large as it.
    """

    log_depth: np.ndarray
    shift_error: np.ndarray
    errors: list[np.ndarray]


@dataclass(frozen=True)
class _Fit:
    """What is known of the fit of a frame.

    Attributes:
        line: scale and shift that bring its inverse depth to that of the cameras.
        middle: median inverse depth of what it was fitted to.
        shift_sigma: standard deviation of the shift.
        error: [h, w] by how much, in ln, fitted depth is too far, where that is known: ``sure`` [h, w], 0 or 1.
    """

    line: tuple[float, float]
    middle: float
    shift_sigma: float
    error: np.ndarray
    sure: np.ndarray


class MonocularDistances:
    """Monocular depth of the objects of a clip, frame by frame."""

    def __init__(self, maps: MonocularMaps, background: Background):
        self._maps, self._background, self._told = maps, background, dict[int, Told]()
        self._every = max(1, len(maps.clip) // _STATISTICS_FRAMES)

    def look(self, k: int, mask: np.ndarray, numbers: list[int], camera: Camera, normal: np.ndarray) -> None:
        """Take in training frame k.

        Args:
            mask: object numbers [H, W].
            numbers: of those to look at.
            normal: [3] up.
        """
        (inverse, known), fit = self._maps[k], self._fit(k)
        if fit is None:
            return
        log_depth, square = -np.log(self._apply(fit.line, inverse)), np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)
        focal, size, count = float(camera.K[0, 0]), fit.error.shape[::-1], len(self._maps.clip)
        for number in numbers:
            told = self._told.setdefault(number, Told(np.full(count, np.nan), np.full(count, np.nan), []))
            inside = mask == number
            inner = cv2.erode(np.pad(inside.astype(np.uint8), 1, mode="edge"), square)[1:-1, 1:-1] > 0
            chosen = (inner if inner.any() else inside) & (known >= TRUSTED_CONFIDENCE)
            if not chosen.any():
                continue
            y, x = np.nonzero(chosen)
            middle = middle_of(inside)
            upright = np.log(upright_ratio(camera, normal, middle, np.stack([x, y], 1) + 0.5)) + roundness(inside, focal)[y, x]
            told.log_depth[k] = np.median(log_depth[y, x] - upright)
            # Scale and shift are known together at the middle of what rests: an error of the shift turns the line about it.
            told.shift_error[k] = fit.shift_sigma * abs(np.exp(np.median(log_depth[y, x])) - 1 / fit.middle)
            if k % self._every == 0:
                small = cv2.resize(inside.astype(np.float32), size, interpolation=cv2.INTER_AREA)
                told.errors.append(_area_errors(fit.error, fit.sure, max(round(float(np.sqrt(small.sum()))), 3)))

    def cue(self, number: int, depth_trajectory: np.ndarray) -> Cue | None:
        """Return what is said of an object with such a depth trajectory [T]; None where that, or how wrong it is, is not known."""
        told = self._told.get(number)
        if told is None or not told.errors:
            return None
        errors = np.concatenate(told.errors)
        says = told.log_depth - depth_trajectory
        says = says[np.isfinite(says)]
        if len(errors) < MIN_AREAS or not len(says):
            return None
        value = float(np.median(says))
        over_time = 1.4826 * float(np.median(np.abs(says - value))) / np.sqrt(max(1.0, len(says) / INDEPENDENT_FRAMES))
        of_areas, of_shift = ERROR_RATIO * 1.4826 * float(np.median(np.abs(errors))), float(np.nanmedian(told.shift_error))
        return Cue(value, float(np.linalg.norm([of_areas, of_shift, over_time])), MONOCULAR_ERROR_RATE)

    def _fit(self, k: int) -> _Fit | None:
        """Fit a frame to what rests in it; None where too little does, or it does not tell how."""
        inverse, known = self._maps.small(k)
        measured, weight = self._background.fill(k)
        sure = (weight > SURE_WEIGHT) & (known >= TRUSTED_CONFIDENCE) & (self._background.mask(k) == 0)
        chosen = np.flatnonzero(sure)
        if len(chosen) < MIN_STATIC_PIXELS:
            return None
        chosen = chosen[:: -(-len(chosen) // MAX_FIT_SAMPLES)]
        relative = self._maps.source.relative
        x, y = inverse.ravel()[chosen].astype(np.float64), measured.ravel()[chosen].astype(np.float64)
        if x.min() == x.max():
            return None
        # The errors are the source's, so it is explained by what is measured: the other way round they would flatten the line.
        start = float(2 * x.min() - x.max()) if relative else 0.0  # of what has no zero of its own
        slope, rise = fit_line(y, x - start, y**-2, RELATIVE_SHIFT_SIGMA if relative else METRIC_SHIFT_SIGMA)
        spread, middle = float(x.std() * y.std()), float(np.median(y))
        correlation = float(((x - x.mean()) * (y - y.mean())).mean() / spread) if spread > 0 else 0.0
        shared = max(correlation, 0.0) ** 2  # what runs the other way round tells nothing
        told = middle * (1 / shared - 1) if shared >= MIN_SHARED_VARIANCE else np.inf
        shift_sigma = min(told, np.inf if relative else METRIC_SHIFT_SIGMA * middle)
        if slope <= 0 or not np.isfinite(shift_sigma):
            return None
        line = 1 / slope, -(start + rise) / slope
        error = np.log(np.maximum(measured, 1e-9)) - np.log(self._apply(line, inverse))
        return _Fit(line, middle, shift_sigma, np.where(sure, error, 0), sure.astype(np.float64))

    def _apply(self, line: tuple[float, float], inverse: np.ndarray) -> np.ndarray:
        median = self._maps.clip.median
        return np.clip(line[0] * inverse + line[1], median / MAX_DEPTH, median / MIN_DEPTH)


def _area_errors(error: np.ndarray, sure: np.ndarray, side: int) -> np.ndarray:
    """Return the mean error [n] of squares of ``side`` pixels all over the image, half of it apart, where it is known."""

    def add(values: np.ndarray) -> np.ndarray:
        sums = cv2.boxFilter(values.astype(np.float64), -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        return sums[:: max(side // 2, 1), :: max(side // 2, 1)]

    known = add(sure)
    enough = known >= MIN_COVERAGE * side**2
    return add(error)[enough] / known[enough]
