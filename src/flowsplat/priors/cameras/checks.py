"""Judge estimated cameras, in words for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowsplat.priors.cameras.estimate import CameraEstimate

UNCERTAIN_FOCAL = 0.05
"""Standard deviation of log focal from which the focal length counts as a guess. Chosen by eye."""
LARGE_ERROR = 0.5
"""Pixels of the working size from which the fit counts as poor (docs/method/evaluation.md: half a pixel costs 3 dB).
"""
MIN_PARALLAX = 0.5
"""Degrees below which depth from the camera's motion counts as uncertain. Chosen by eye."""
MIN_STATIC_SHARE = 0.4
"""Share of static tracks below which the cameras may follow something that moves. Chosen by eye."""
MAX_NAMED_FRAMES = 6
"""Frames or stretches of frames that a sentence lists. Chosen by eye."""


@dataclass(frozen=True)
class Gaps:
    """Frames of a clip that its cameras do not follow from the ones before.

    Attributes:
        unplaced: frames that show too little, between others that do not.
        breaks: the first frames after a cut.
        blank: frames that show nothing at all.
        jumps: frames before which the path turns or leaps as nowhere else.
        timestamps: [T] seconds of all frames of the clip.
    """

    unplaced: Sequence[int]
    breaks: Sequence[int]
    blank: Sequence[int]
    jumps: Sequence[int]
    timestamps: np.ndarray


def verdict(found: CameraEstimate, unit: float, width: int, focal_given: bool, gaps: Gaps, more: Sequence[str] = ()) -> str:
    """Return one or more sentences on what kind of camera motion was found and how far to trust it.

    Args:
        found: the cameras, or those of the longest piece of a clip with cuts.
        unit: pixels of the frames in a pixel of ``found``.
        width: pixels of the frames.
        more: further sentences.
    """
    fit = found.fit
    median = float(np.median(fit.errors))
    if found.motion == "unknown":
        kind = "Nothing in the images could be followed: the camera is taken to stand still."
    elif found.motion == "static":
        kind = "The camera stands still: all cameras are the same, and its motion shows no depth."
    elif found.motion == "rotation":
        kind = "The camera only turns: its motion shows no depth."
    elif np.degrees(found.parallax) < MIN_PARALLAX:
        kind = "The camera hardly leaves its place: its motion shows little depth."
    else:
        kind = "The camera moves."
    sentences = [kind]
    if found.motion in ("free", "rotation"):
        angle = 2 * np.degrees(np.arctan(width / 2 / (fit.state.focal * unit)))
        sentences.append(f"Static points are met to {median * unit:.2f} pixels (median), field of view {angle:.0f} degrees.")
        if median > LARGE_ERROR:
            sentences.append("That is poor: expect blur, and consider giving cameras from another tool.")
        if found.flat:
            sentences.append("One plane explains all that stands still.")
        if not focal_given and (fit.focal_sigma > UNCERTAIN_FOCAL or found.flat):
            sentences.append("The focal length is a guess: this motion hardly shows it.")
    if found.surrounds:
        sentences.append("Something that moves fills most of the image: the camera was taken from what is seen round it.")
    elif found.motion == "free" and fit.static.mean() < MIN_STATIC_SHARE:
        sentences.append(f"Only {100 * fit.static.mean():.0f} % of what was followed stands still: this may be another motion.")
    return " ".join([*sentences, *_gaps(gaps), *(sentence for sentence in more if sentence)])


def _gaps(gaps: Gaps) -> list[str]:
    sentences = []
    if gaps.breaks:
        places = _join_names([f"{t} ({gaps.timestamps[t] - gaps.timestamps[0]:.2f} s)" for t in gaps.breaks])
        cuts = f"There is a cut before frame {places}" if len(gaps.breaks) == 1 else f"There are cuts before frames {places}"
        sentences.append(f"{cuts}: nothing joins the pieces, so use one of them with --start and --end.")
    if len(gaps.blank) == len(gaps.timestamps):
        sentences.append("All frames are blank.")
    elif gaps.blank:
        are = "is blank, and its camera is" if len(gaps.blank) == 1 else "are blank, and their cameras are"
        sentences.append(f"{_stretches(gaps.blank)} {are} interpolated.")
    if gaps.unplaced:
        many = len(gaps.unplaced) > 1
        are = "show too little to be placed, and their cameras are" if many else "shows too little to be placed, and its camera is"
        sentences.append(f"{_stretches(gaps.unplaced)} {are} interpolated.")
    if gaps.jumps:
        places = _join_names([str(t) for t in gaps.jumps])
        sentences.append(f"The path jumps before frame {places}: look there before you trust these cameras.")
    return sentences


def _stretches(frames: Sequence[int]) -> str:
    """ "Frame 3", or "Frames 3, 7 to 9"."""
    rising = np.array(sorted(frames))
    parts = np.split(rising, 1 + np.flatnonzero(np.diff(rising) > 1))
    names = [name for part in parts for name in (map(str, part) if len(part) < 3 else [f"{part[0]} to {part[-1]}"])]
    return f"Frame{'s' * (len(rising) > 1)} {_join_names(names)}"


def _join_names(names: Sequence[str]) -> str:
    more = [f"{len(names) - MAX_NAMED_FRAMES} more"] if len(names) > MAX_NAMED_FRAMES else []
    shown = [*names[:MAX_NAMED_FRAMES], *more]
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"
