"""Depth that was made image by image, by a network or in other units than the cameras', fitted to the cameras.

Such depth knows how an image is built, objects included, but neither its scale nor, often, where infinity lies. Both are
found for every frame from the static scene, whose inverse depth the matches tell (``background``): a robust line through
(monocular, measured) inverse depths. Where the scene rests and its matches are trusted, what they say stays; elsewhere,
and on objects above all, the fitted monocular depth is taken.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.files import read_npz, write_npz
from flowsplat.common.progress import track
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.interpolation import sample_map
from flowsplat.priors.background.fill import fill, upsample
from flowsplat.priors.background.matched_clip import MatchedClip
from flowsplat.priors.background.static_depth import SURE_WEIGHT, Background, compute_far_inverse
from flowsplat.priors.depth.stage import FRONT_MARGIN, MAX_DEPTH, MIN_DEPTH, TRUSTED_WEIGHT, measure_trusted_shares
from flowsplat.priors.flow import FlowEstimator, dis_estimator
from flowsplat.scenes import Depth, Scene
from flowsplat.scenes.layers import TRUSTED_CONFIDENCE

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

FURTHEST_INVERSE_RATIO = 0.1
"""Without parallax: inverse depth of the furthest percent of the clip over its median, where infinity is not known.
Chosen by eye."""

_MAX_FIT_SAMPLES = 20_000
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


def monocular_stage(scene: Scene, source: Monocular, estimate: FlowEstimator = dis_estimator) -> None:
    """Depth with confidence for every training frame from monocular depth. Needs cameras and flow, uses masks if there are any.

    Without parallax nothing measures scale and shift: the frames are then fitted to each other, the whole clip gets an
    arbitrary scale, and the verdict says so.

    Args:
        estimate: finds the flow between frames that are no neighbors.
    """
    folder = scene.folder / "monocular"
    clip = MatchedClip(scene, estimate)
    for i in track(scene.train_frames, "Monocular depth"):
        if not (folder / f"{i:05d}.npz").exists():
            inverse, confidence = source.inverse(i)
            write_npz(folder / f"{i:05d}.npz", {"inverse": inverse.astype(np.float32), "confidence": confidence.astype(np.float16)})
    maps = _Maps(clip, folder)
    write = _write_measured if clip.has_parallax else _write_free
    figures = write(maps, source)
    trusted, still = measure_trusted_shares(scene)
    verdict = f"{source.source}, {figures.pop('verdict')}, {still:.0%} of the still scene trusted"
    scene.finish_prior(
        "depth", method=source.method, verdict=verdict, trusted=round(trusted, 4), trusted_static=round(still, 4), **figures
    )
    shutil.rmtree(folder, ignore_errors=True)


class _Maps:
    """What the source said, by position in the training frames."""

    def __init__(self, clip: MatchedClip, folder: Path):
        self.clip, self.scene, self._folder = clip, clip.scene, folder
        self.has_masks = all(self.scene.has_mask(i) for i in self.scene.train_frames)

    def __getitem__(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return inverse depth and confidence [H, W] float32 at the size of the frames."""
        arrays = read_npz(self._folder / f"{self.scene.train_frames[k]:05d}.npz")
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


def _write_measured(maps: _Maps, source: Monocular) -> dict[str, object]:
    """Fit every frame to the static scene that the matches show, and write it."""
    clip = maps.clip
    background = Background(clip, maps.has_masks)
    lines, misfits = _measure_lines(maps, background, RELATIVE_SHIFT_SIGMA if source.relative else METRIC_SHIFT_SIGMA)
    for k in track(range(len(clip)), "Depth"):
        _write_frame(maps, background, k, lines[k], misfits[k])
    return {
        "verdict": "scale and shift of every frame fitted to the cameras",
        "misfit": round(float(np.median(misfits)), 4), "parallax": round(clip.mean_parallax, 3),
    }  # fmt: skip


def _measure_lines(maps: _Maps, background: Background, loose: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (scale, shift) [T, 2] of every frame, and the median relative error of the fit [T]."""
    count = len(maps.clip)
    lines, misfits = np.full((count, 2), np.nan), np.full(count, np.nan)
    for k in track(range(count), "Fitting depth"):
        measured, weight = background.fill(k)
        inverse, confidence = maps.small(k)
        chosen = np.flatnonzero((weight > SURE_WEIGHT) & (confidence >= TRUSTED_CONFIDENCE) & (background.mask(k) == 0))
        if len(chosen) >= MIN_STATIC_PIXELS:
            chosen = chosen[:: -(-len(chosen) // _MAX_FIT_SAMPLES)]
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


def _write_frame(maps: _Maps, background: Background, k: int, line: np.ndarray, misfit: float) -> None:
    clip, scene = maps.clip, maps.scene
    i = scene.train_frames[k]
    frame, moving, size = scene.frame(i), maps.read_objects(k), (scene.width, scene.height)
    inverse, known = maps[k]
    floor, ceiling = clip.median / MAX_DEPTH, clip.median / MIN_DEPTH
    measured, weight = background.fill(k)
    weight = np.where(background.mask(k) > 0, 0, weight).astype(np.float32)
    plate = upsample(background.plate(k), np.zeros_like(frame), *size)
    behind = np.where(moving, plate, upsample(measured, frame, *size))
    aligned = np.where(known >= TRUSTED_CONFIDENCE, line[0] * inverse + line[1], behind)
    aligned = np.clip(aligned, floor, ceiling).astype(np.float32)
    # What is measured bends the monocular depth towards it, and what lies between two measurements bends along.
    small = cv2.resize(aligned, (clip.width, clip.height), interpolation=cv2.INTER_AREA)
    trusted = np.where(weight > TRUSTED_WEIGHT, weight, 0)
    bend = fill(measured - small, trusted, clip.image(k))[0] if trusted.any() else np.zeros_like(small)
    static = np.clip(aligned + upsample(bend, frame, *size), floor, ceiling)
    front = upsample(background.compute_foremost(k), np.zeros_like(frame), *size)
    depth = 1 / np.clip(np.where(moving, np.maximum(aligned, FRONT_MARGIN * front), static), floor, ceiling)
    own = np.float32(1 / (1 + (misfit / HALF_TRUST_MISFIT) ** 2)) * known
    seen = np.maximum(upsample(weight, np.zeros_like(frame), *size), 0)
    confidence = np.where(moving, own, np.maximum(own, seen / (seen + TRUSTED_WEIGHT)))
    scene.write_depth(i, Depth(depth.astype(np.float32), confidence.astype(np.float32)))


def _write_free(maps: _Maps, source: Monocular) -> dict[str, object]:
    """Without parallax: fit the frames to each other, scale the clip so that its cameras see no parallax, and write it."""
    clip, scene = maps.clip, maps.scene
    lines = _chain_lines(maps, source.relative)
    samples = np.concatenate([
        (lines[k, 0] * maps.small(k)[0] + lines[k, 1]).ravel()[::17] for k in range(0, len(clip), max(1, len(clip) // 16))
    ])  # fmt: skip
    middle, far = float(np.median(samples)), float(np.percentile(samples, 1))
    shift = 0.0
    if source.relative or far <= 0:
        shift = (FURTHEST_INVERSE_RATIO * middle - far) / (1 - FURTHEST_INVERSE_RATIO)
    scale = compute_far_inverse(clip) / max(middle + shift, 1e-9)
    floor, ceiling = scale * (middle + shift) / MAX_DEPTH, scale * (middle + shift) / MIN_DEPTH
    for k, i in enumerate(track(scene.train_frames, "Depth")):
        inverse, known = maps[k]
        aligned = np.clip(scale * (lines[k, 0] * inverse + lines[k, 1] + shift), floor, ceiling)
        scene.write_depth(i, Depth((1 / aligned).astype(np.float32), np.float32(0.6) * known))
    return {
        "verdict": "the camera does not travel, so scale and shift are free and the same for the whole clip: "
        "new views from aside keep the order of things, not their distance",
        "parallax": round(clip.mean_parallax, 3),
    }  # fmt: skip


def _chain_lines(maps: _Maps, relative: bool) -> np.ndarray:
    """Return (scale, shift) [T, 2] that make every frame's inverse depth agree with that of the frame before where nothing moves.

    Median and spread are made equal and no line is fitted: a fit would flatten the clip, a little with every frame.

    Args:
        relative: whether frames differ by a shift too, and not only by their scale.
    """
    clip = maps.clip
    lines = np.tile([1.0, 0.0], (len(clip), 1))
    grid = pixel_grid(clip.width, clip.height)
    for before, k in pairwise(range(len(clip))):
        flow, confidence = clip.step_flow(k, before)
        landed = (grid + flow).reshape(-1, 2)
        moves_there = sample_map(maps.read_objects_small(before), landed)[:, 0].reshape(confidence.shape)
        chosen = (maps.read_objects_small(k) == 0) & (moves_there == 0) & (confidence >= TRUSTED_CONFIDENCE)
        lines[k] = lines[before]
        if not clip.continuity.same_piece(k, before):
            # Nothing is known across a cut; what comes after it is as far away as what came before.
            middle = lines[before, 0] * float(np.median(maps.small(before)[0])) + lines[before, 1]
            here = float(np.median(maps.small(k)[0]))
            lines[k] = (lines[before, 0], middle - lines[before, 0] * here) if relative else (middle / max(here, 1e-9), 0.0)
        elif chosen.sum() >= MIN_STATIC_PIXELS:
            here = maps.small(k)[0][chosen]
            there = sample_map(maps.small(before)[0], landed[chosen.ravel()])[:, 0]
            middles = float(np.median(there)), float(np.median(here))
            # Without a shift of its own a frame differs by its scale alone.
            sizes = [np.subtract(*np.percentile(values, [80, 20])) for values in (there, here)] if relative else middles
            ratio = sizes[0] / sizes[1] if min(sizes) > 1e-9 else 1.0
            shift = middles[0] - ratio * middles[1]
            lines[k] = lines[before, 0] * ratio, lines[before, 0] * shift + lines[before, 1]
    return lines
