"""Stand-ins for learned priors, with known errors: true depth and masks of a rendered scene, made worse.

Depth is disparity with a scale and a shift of its own in every frame. Its error, in ln depth, is smooth over ``SMOOTH_PIXELS`` and
lasts: that of what rests stays where it is in the image, that of every object moves with it. To this comes what flickers. Outlines
are off by some pixels, and one object is lost for a while.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from flowsplat.priors.given import GivenPriors
from flowsplat.priors.options import PriorsOptions
from flowsplat.scenes.clip import InputOptions, Truth
from flowsplat.scenes.ingest import open_clip

SMOOTH_PIXELS = 60.0
"""Distance at which errors of two pixels have a correlation of 1/e."""
FLICKER = 0.02
"""Standard deviation of the error, in ln depth, that differs from frame to frame, as smooth."""
BLUR = 1.5
"""Pixels, standard deviation."""
MAX_SCALE, MAX_SHIFT = 0.3, 0.2
"""Scales lie within this of 1, in ln; shifts within this, over the median disparity."""
LOST_FRAMES = 10
"""Frames for which one object has no mask."""


@dataclass(frozen=True)
class StandIn:
    """Which stand-ins a run gets, and how wrong they are."""

    depth: Literal["cue", "all", "none"] = "cue"
    """What depth is used for: as a cue for the distance of objects, as all depth, or for nothing."""
    error: float = 0.04
    """Standard deviation of the error of depth that lasts, in ln depth."""
    masks: Literal["own", "given"] = "given"
    """Own masks, or true ones made worse."""
    outline: int = 0
    """Pixels by which outlines of given masks are off. With 0 they are true, and no object is lost."""
    noise: int = 0
    """Seed of the errors."""

    @property
    def words(self) -> str:
        """For people."""
        depth = (
            "no depth"
            if self.depth == "none"
            else f"depth {self.error:.0%} off {'as a cue' if self.depth == 'cue' else 'as all depth'}"
        )
        masks = "own masks" if self.masks == "own" else f"masks {self.outline} pixels off" if self.outline else "true masks"
        return f"{depth}, {masks}, noise {self.noise}"

    def give(self, source: Path, options: InputOptions, folder: Path, priors: PriorsOptions) -> PriorsOptions:
        """Return the options of a run on a rendered scene that is given the stand-ins; they are written into ``folder``.

        Raises:
            InputError: the scene cannot be read, or has no truth.
        """
        clip = open_clip(source, options)
        assert clip.truth is not None  # a rig has
        frames, given = range(len(clip.timestamps)), GivenPriors()
        if self.depth != "none":
            path = folder / f"depth_{self.error}_{self.noise}"
            write_depth(clip.truth, frames, path, self.error, self.noise)
            given = replace(given, object_depth=path) if self.depth == "cue" else replace(given, depth=path)
            given = replace(given, depth_kind="disparity")
        if self.masks == "given":
            path = folder / f"masks_{self.outline}_{self.noise}"
            write_masks(clip.truth, frames, path, self.outline, self.noise)
            given = replace(given, masks=path)
        return replace(priors, given=given)


def write_depth(truth: Truth, frames: Sequence[int], folder: Path, error: float, seed: int) -> None:
    """Write disparity of frames, 00000.npy ... [H, W] float32.

    Args:
        error: standard deviation of what lasts, in ln depth.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    fields: dict[int, np.ndarray] = {}
    middles: dict[int, np.ndarray] = {}
    for i in frames:
        log_depth, mask = np.log(truth.depth(i).depth.astype(np.float64)), truth.mask(i)
        shape = (mask.shape[0], mask.shape[1])
        off = np.zeros(shape)
        for number in [0, *(int(n) for n in np.unique(mask) if n)]:
            inside = mask == number
            field = fields.setdefault(number, error * _draw_field(rng, shape))
            if number:
                y, x = np.nonzero(inside)
                middle = np.array([np.median(y), np.median(x)])
                moved = np.rint(middle - middles.setdefault(number, middle)).astype(int)
                field = np.roll(field, tuple(moved), axis=(0, 1))
            off[inside] = field[inside]
        log_depth += off + FLICKER * _draw_field(rng, shape)
        disparity = cv2.GaussianBlur(np.exp(-log_depth), (0, 0), BLUR)
        typical = float(np.median(disparity))
        scale, shift = np.exp(rng.uniform(-MAX_SCALE, MAX_SCALE)), rng.uniform(-MAX_SHIFT, MAX_SHIFT) * typical
        values = disparity + max(shift, 1e-3 * typical - float(disparity.min()))  # 0 would mean that nothing is known
        np.save(folder / f"{i:05d}.npy", (scale * values).astype(np.float32))


def write_masks(truth: Truth, frames: Sequence[int], folder: Path, outline: int, seed: int) -> None:
    """Write object numbers of frames, 00000.png ... [H, W] uint8.

    Args:
        outline: pixels by which outlines are off, outwards or inwards, object by object and for the whole clip.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    numbers = sorted({int(n) for i in frames for n in np.unique(truth.mask(i)) if n})
    outwards = {number: bool(rng.integers(2)) for number in numbers}
    lost = numbers[int(rng.integers(len(numbers)))] if numbers and outline else 0
    first = int(rng.integers(max(len(frames) - LOST_FRAMES, 1)))
    square = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * outline + 1, 2 * outline + 1))
    for k, i in enumerate(frames):
        mask = truth.mask(i)
        result = np.zeros_like(mask)
        for number in numbers:
            if number == lost and first <= k < first + LOST_FRAMES:
                continue
            inside = (mask == number).astype(np.uint8)
            inside = cv2.dilate(inside, square) if outwards[number] else cv2.erode(inside, square)
            result[(inside > 0) & (result == 0)] = number
        cv2.imwrite(str(folder / f"{i:05d}.png"), result)


def _draw_field(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Return [H, W] of mean 0 and standard deviation 1, smooth over ``SMOOTH_PIXELS``."""
    # Noise blurred by s is correlated by exp(-(d / 2 s)^2); what is drawn around the image makes its border like the rest.
    sigma = SMOOTH_PIXELS / 2
    border = int(3 * sigma)
    noise = rng.standard_normal((shape[0] + 2 * border, shape[1] + 2 * border))
    field = cv2.GaussianBlur(noise, (0, 0), sigma)[border:-border, border:-border]
    return field * (2 * np.sqrt(np.pi) * sigma)
