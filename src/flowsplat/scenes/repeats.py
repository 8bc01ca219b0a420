"""Frames that show nothing of their own: those that repeat the one before, blank ones, and those of a fade.

A clip that was brought from 24 to 60 frames a second by repeating frames, or encoded anew after that, has near-identical
neighbors. Held-out frames then have twins in training, and their figures are untrue.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.images.blank import MAX_BLANK_SIGMA

LOOK_SIDE = 320
"""Pixels of the longer side at which frames are compared, in blocks of ``BLOCK`` pixels. Chosen by eye."""
BLOCK = 8
"""Pixels of the side of a block. The one that changes most counts, so that something small that moves is seen. Chosen by eye."""
MAX_REPEATS = 8
"""Repeats of one frame that are looked for: 15 frames a second shown at 120."""
TWIN_RATIO = 0.2
"""Change of a repeat, relative to the real steps before and after it, where a clip is told to repeat frames.

Of 10 clips (six of DAVIS, four rendered ones) no real step has less than .53; of 18 random worlds of 40 frames, three have one
between .2 and .3. Repeats have at most .19 where the clip was encoded as H.264 after (crf 18 to 33).
"""
CONVERTED_RATIO = 0.4
"""The same in a clip that is known to repeat frames: a key frame differs more from its twin (MPEG-4 at a low rate: up to .5).
At .2 more twins are missed, at .5 real frames are left out: 10 clips and worlds, each from 24 and 15 to 60 and from 24 and 25
to 30 frames a second."""
MIN_SHARE = 1 / 30
"""Share of the frames that must be repeats, so that the clip is known to repeat frames: 1 of 25 from 24 to 25 a second."""
MIN_STEP = 4.0
"""Gray levels by which a real step changes its block at least: below it are the noise of a sensor and of encoding. Of still
cameras with noise of 0 to 5 levels, raw and encoded, no frame is left out at 2, 4 or 8, and most repeats are found at 2 and 4."""
FADE_SECONDS = 3.0
"""Seconds of a fade at most. Chosen by eye."""
AHEAD_SECONDS = 0.5
"""Seconds within which the contrast of a fading image rises visibly. Chosen by eye."""
MAX_FADE_CONTRAST = 0.95
"""Contrast of an image, relative to those that follow it, up to which it is fading. Chosen by eye."""
MAX_FADE_START = 0.5
"""The same of the first image of a fade: what follows blank frames brighter than that is no fade. Chosen by eye."""


@dataclass(frozen=True)
class Changes:
    """What is seen of N frames in a row.

    Attributes:
        steps: [N] mean change in gray levels, since the frame before, of the block that changed most; infinite where not known.
        contrasts: [N] standard deviation in gray levels; infinite where not known.
    """

    steps: np.ndarray
    contrasts: np.ndarray


def look_size(width: int, height: int) -> tuple[int, int]:
    """Return (width, height) at which frames of that size are compared."""
    scale = min(1.0, LOOK_SIDE / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def measure_changes(images: Iterable[np.ndarray | None], count: int) -> Changes:
    """Go through gray images [h, w] uint8 of ``look_size``; None where one cannot be read."""
    steps, contrasts = np.full(count, np.inf), np.full(count, np.inf)
    before: np.ndarray | None = None
    for i, image in enumerate(images):
        if image is not None:
            contrasts[i] = image.std()
            if before is not None and before.shape == image.shape:
                change = cv2.absdiff(image, before).astype(np.float32)
                blocks = max(1, image.shape[1] // BLOCK), max(1, image.shape[0] // BLOCK)
                steps[i] = cv2.resize(change, blocks, interpolation=cv2.INTER_AREA).max()
        before = image
    return Changes(steps, contrasts)


def find_repeats(steps: np.ndarray) -> np.ndarray:
    """Return [N] bool: which frames only repeat the one before, as a change of the frame rate leaves them.

    A step is that of a repeat if it is far below the real steps on both sides. Where something rests, steps are small for longer
    than a change of rate repeats frames: a rest is part of the motion, so its frames stay, at the rate of the others.

    Args:
        steps: as in ``Changes``.
    """
    levels = _levels(np.where(np.isfinite(steps), steps, 0))
    low = _find_low(steps, levels, TWIN_RATIO)
    if low.sum() < max(1, MIN_SHARE * len(steps)):
        return np.zeros(len(steps), bool)
    # A rest has no real steps beside it: what changes as little as repeats do counts there.
    low = _find_low(steps, levels, CONVERTED_RATIO) | (steps <= np.quantile(steps[low], 0.9))
    real = np.flatnonzero(~low)
    lengths = np.diff(np.append(real, len(steps)))
    cycle = lengths[lengths <= np.median(lengths) + 1].mean()  # frames for which one is shown, and of a rest one is kept
    place = np.arange(len(steps)) - real[np.searchsorted(real, np.arange(len(steps)), side="right") - 1]
    return low & (np.floor(place / cycle) == np.floor((place - 1) / cycle))


def _levels(steps: np.ndarray) -> np.ndarray:
    """Return [N] the lesser of the largest steps shortly before and after; sides that the clip's ends cut off do not count."""
    levels = np.zeros(len(steps))
    for i in range(1, len(steps)):
        before, after = steps[max(1, i - MAX_REPEATS) : i], steps[i + 1 : i + 1 + MAX_REPEATS]
        whole = [side.max() for side in (before, after) if len(side) == MAX_REPEATS]
        levels[i] = min(whole) if whole else max((side.max() for side in (before, after) if len(side)), default=0.0)
    return levels


def _find_low(steps: np.ndarray, levels: np.ndarray, ratio: float) -> np.ndarray:
    """Return [N] bool: steps far below ``levels``, in runs that real steps bound."""
    low = (levels >= MIN_STEP) & (steps < ratio * levels)
    low[0] = False
    edges = np.flatnonzero(np.diff(np.concatenate([[False], low, [False]])))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        least = ratio * levels[start:end].max()
        if (start > 1 and steps[start - 1] < least) or (end < len(steps) and steps[end] < least):
            low[start:end] = False
    return low


def find_fades(contrasts: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Return [N] bool: which frames are blank (of one color), or fade from or to blank ones; none where hardly any other remains.

    Args:
        contrasts: as in ``Changes``.
        seconds: [N] rising, when they are shown.
    """
    blank = contrasts < MAX_BLANK_SIGMA
    fading = blank | _find_rising(contrasts, blank, seconds) | _find_rising(contrasts[::-1], blank[::-1], -seconds[::-1])[::-1]
    return fading if (~fading).sum() >= 2 else np.zeros(len(fading), bool)


def _find_rising(contrasts: np.ndarray, blank: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Return [N] bool: frames whose contrast rises from a blank one's on."""
    rising = np.zeros(len(blank), bool)
    for start in np.flatnonzero(blank[:-1] & ~blank[1:]) + 1:
        least = MAX_FADE_START
        for i in range(start, len(blank)):
            ahead = contrasts[(seconds > seconds[i]) & (seconds <= seconds[i] + AHEAD_SECONDS) & np.isfinite(contrasts)]
            late = seconds[i] - seconds[start] > FADE_SECONDS
            if late or contrasts[i] <= contrasts[i - 1] or not len(ahead) or contrasts[i] >= least * ahead.max():
                break
            rising[i], least = True, MAX_FADE_CONTRAST
    return rising
