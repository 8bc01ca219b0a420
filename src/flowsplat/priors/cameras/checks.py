"""What can be said about estimated cameras, in words for people."""

from __future__ import annotations

import numpy as np

from flowsplat.priors.cameras.estimate import Estimate

UNCERTAIN_FOCAL = 0.05
"""Standard deviation of log focal from which the focal length counts as a guess."""
LARGE_ERROR = 0.5
"""Pixels of the working size from which the fit counts as poor (METHOD 6: half a pixel costs 3 dB)."""
LITTLE_PARALLAX = 0.5
"""Degrees below which depth from the camera's motion counts as uncertain."""

FEW_STATIC = 0.4
"""Share of static tracks below which the cameras may follow something that moves."""


def verdict(found: Estimate, unit: float, width: int, focal_given: bool) -> str:
    """One or more sentences on what kind of camera motion was found and how far to trust it.

    Args:
        unit: pixels of the frames in a pixel of ``found``.
        width: pixels of the frames.
    """
    fit = found.fit
    if found.motion == "unknown":
        return "Nothing in the pictures could be followed: the camera is taken to stand still."
    if found.motion == "static":
        return "The camera stands still: all cameras are the same, and its motion shows no depth."
    median = float(np.median(fit.errors))
    angle = 2 * np.degrees(np.arctan(width / 2 / (fit.state.focal * unit)))
    sentences = ["The camera moves." if found.motion == "free" else "The camera only turns: its motion shows no depth."]
    if found.motion == "free" and np.degrees(found.parallax) < LITTLE_PARALLAX:
        sentences = ["The camera turns and hardly leaves its place: its motion shows little depth."]
    sentences.append(f"Static points are met to {median * unit:.2f} pixels (median), {angle:.0f} degrees across.")
    if not focal_given and fit.focal_sigma > UNCERTAIN_FOCAL:
        sentences.append("The focal length is a guess: this motion hardly shows it.")
    if median > LARGE_ERROR:
        sentences.append("That is poor: expect blur, and consider giving cameras from another tool.")
    share = fit.static.mean()
    if share < FEW_STATIC:
        sentences.append(f"Only {100 * share:.0f} % of what was followed stands still: this may be another motion.")
    if found.breaks:
        sentences.append(f"Frame {found.breaks[0]} shares nothing with the one before it: cut the clip there.")
    if found.unplaced:
        sentences.append(f"{len(found.unplaced)} frames show too little to be placed; their cameras are interpolated.")
    return " ".join(sentences)
