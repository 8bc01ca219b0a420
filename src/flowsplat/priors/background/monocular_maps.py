"""Depth that was made image by image, by a network or in other units than the cameras', fitted to the cameras.

Such depth knows how an image is built, objects included, but neither its scale nor, often, where infinity lies. Both are
found for every frame from the static scene, whose inverse depth the matches tell: a robust line through (monocular, measured)
inverse depths.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.files import read_npz, write_npz
from flowsplat.common.progress import track
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.static_depth import SURE_WEIGHT, Background
from flowsplat.scenes.layers import TRUSTED_CONFIDENCE

FOLDER = "monocular"
"""Of the scene, for what the source said, of no use once depth exists."""
MIN_STATIC_PIXELS = 200
"""Trusted static working pixels that a frame's own scale and shift need; with fewer it borrows those of its neighbors.
Chosen by eye."""

HALF_TRUST_MISFIT = 0.2
"""Median relative error of the fitted depth at which it is half trusted. Chosen by eye."""

INDEPENDENT_SAMPLES = 100
"""Independent samples that all pixels of a frame are worth. Chosen by eye."""

RELATIVE_SHIFT_SIGMA, METRIC_SHIFT_SIGMA = 0.5, 0.05
"""Shift of the inverse depth to be expected, over its median, where the source does not know infinity and where it does.
Chosen by eye."""

MAX_FIT_SAMPLES = 20_000
"""Pixels of a frame that the fit uses, at most, for the time. A round number."""
_FIT_ROUNDS = 20
"""Rounds of reweighting of the fit. Chosen by eye."""


@dataclass(frozen=True)
class Monocular:
    """Where monocular depth comes from.

    Attributes:
        method: its name, for provenance.
        source: more about it, for the verdict.
        relative: whether inverse depth is known up to a shift too, and not only up to scale.
        inverse: from a training frame's number to inverse depth and confidence, each [H, W] float32.
    """

    method: str
    source: str
    relative: bool
    inverse: Callable[[int], tuple[np.ndarray, np.ndarray]]


def fit_line(x: np.ndarray, y: np.ndarray, weights: np.ndarray, loose: float) -> tuple[float, float]:
    """Scale a > 0 and shift b with y ~ a x + b: Cauchy-weighted least squares, its width the median residual.

    The shift is expected to be small: where the values hardly differ (a wall), scale and shift cannot be told apart, and
    the shift stays near 0. Neighboring pixels err together, so all samples count as ``INDEPENDENT_SAMPLES`` independent ones.

    Args:
        x: [N] monocular inverse depths.
        y: [N] measured ones, positive.
        weights: [N] >= 0.
        loose: standard deviation that the shift is expected to have, over the median of ``y``.

    Returns:
        (a, b). Where x runs against y, a is the ratio of the medians (0 at least) and b is 0.
    """
    typical = float(np.median(y))
    robust = weights / weights.sum()
    variance = (0.1 * typical) ** 2
    a, b = 0.0, 0.0
    for _ in range(_FIT_ROUNDS):
        xx, xo, xy, oy = ((robust * values).sum() for values in (x * x, x, x * y, y))
        one = 1 + variance / INDEPENDENT_SAMPLES / (loose * typical) ** 2
        determinant = xx * one - xo * xo
        if determinant <= 0:
            break
        a, b = float((one * xy - xo * oy) / determinant), float((xx * oy - xo * xy) / determinant)
        residual = np.abs(y - a * x - b)
        width = max(1.5 * float(np.median(residual)), 1e-6 * typical)
        robust = weights / (1 + (residual / width) ** 2)
        robust /= robust.sum()
        variance = max(float((robust * residual**2).sum()), (1e-3 * typical) ** 2)
    if a > 0:
        return a, b
    middle = float(np.median(x))
    return (typical / middle, 0.0) if middle > 0 else (0.0, typical)


class MonocularMaps:
    """What a source says of the training frames, by their position; kept in the scene's folder until ``remove``."""

    def __init__(self, clip: MatchedClip, source: Monocular):
        """Ask the source of every frame that it was not asked of yet."""
        self.clip, self.scene, self.source = clip, clip.scene, source
        self._folder = clip.scene.folder / FOLDER / hashlib.sha256(source.source.encode()).hexdigest()[:12]
        for k, i in enumerate(track(self.scene.train_frames, "Monocular depth")):
            if not self._path(k).exists():
                inverse, confidence = source.inverse(i)
                write_npz(self._path(k), {"inverse": inverse.astype(np.float32), "confidence": confidence.astype(np.float16)})
        self.has_masks = all(self.scene.has_mask(i) for i in self.scene.train_frames)

    def __getitem__(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return inverse depth and confidence [H, W] float32 at the size of the frames."""
        arrays = read_npz(self._path(k))
        return arrays["inverse"], arrays["confidence"].astype(np.float32)

    def small(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the same [h, w] at working resolution."""
        size = (self.clip.width, self.clip.height)
        inverse, confidence = (cv2.resize(values, size, interpolation=cv2.INTER_AREA) for values in self[k])
        return inverse, confidence

    def read_objects(self, k: int) -> np.ndarray:
        """bool [H, W]."""
        if not self.has_masks:
            return np.zeros((self.scene.height, self.scene.width), bool)
        return self.scene.mask(self.scene.train_frames[k]) > 0

    def read_objects_small(self, k: int) -> np.ndarray:
        """Return [h, w] float32 at working resolution, above 0 wherever a pixel of it shows something that moves."""
        return cv2.resize(
            self.read_objects(k).astype(np.float32), (self.clip.width, self.clip.height), interpolation=cv2.INTER_AREA
        )

    def remove(self) -> None:
        """Remove the files."""
        shutil.rmtree(self._folder.parent, ignore_errors=True)

    def _path(self, k: int) -> Path:
        return self._folder / f"{self.scene.train_frames[k]:05d}.npz"


def measure_lines(maps: MonocularMaps, background: Background) -> tuple[np.ndarray, np.ndarray]:
    """Return (scale, shift) [T, 2] of every frame, and the median relative error of the fit [T]."""
    count, loose = len(maps.clip), RELATIVE_SHIFT_SIGMA if maps.source.relative else METRIC_SHIFT_SIGMA
    lines, misfits = np.full((count, 2), np.nan), np.full(count, np.nan)
    for k in track(range(count), "Fitting depth"):
        measured, weight = background.fill(k)
        inverse, confidence = maps.small(k)
        chosen = np.flatnonzero((weight > SURE_WEIGHT) & (confidence >= TRUSTED_CONFIDENCE) & (background.mask(k) == 0))
        if len(chosen) >= MIN_STATIC_PIXELS:
            chosen = chosen[:: -(-len(chosen) // MAX_FIT_SAMPLES)]
            x, y, w = (values.ravel()[chosen] for values in (inverse, measured, np.minimum(weight, 100)))
            # A relative error counts alike, near or far.
            lines[k] = fit_line(x, y, w / y**2, loose)
            fitted = np.maximum(lines[k, 0] * x + lines[k, 1], 1e-9)
            misfits[k] = np.median(np.abs(np.log(fitted / y)))
    known = np.flatnonzero(np.isfinite(misfits))
    if len(known) == 0:
        # No frame has enough of its own: the clip's median depth is all that is known.
        middle = np.median([np.median(maps.small(k)[0]) for k in range(0, count, max(1, count // 8))])
        return np.tile([maps.clip.median / max(float(middle), 1e-9), 0.0], (count, 1)), np.full(count, HALF_TRUST_MISFIT)
    pieces = maps.clip.continuity.pieces
    for lost in np.flatnonzero(~np.isfinite(misfits)).tolist():
        own = known[pieces[known] == pieces[lost]]
        lenders = own if len(own) else known
        lines[lost] = [np.interp(lost, lenders, column[lenders]) for column in lines.T]
        misfits[lost] = np.interp(lost, lenders, misfits[lenders])
    return lines, misfits
