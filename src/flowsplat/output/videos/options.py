"""Define the options of videos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from flowsplat.common.errors import InputError
from flowsplat.gaussians.distances import check_factors
from flowsplat.gaussians.renderer import Part, numbers_of
from flowsplat.images.video import MAX_FPS, MIN_FPS
from flowsplat.output.camera_files import MAX_SIDE
from flowsplat.output.videos.paths import PATHS

_MIN_SIDE = 16
"""Pixels of width. Chosen by eye."""
MAX_FRAMES = 100_000
"""Of a video. Chosen by eye."""


@dataclass(frozen=True)
class RenderOptions:
    """Which videos are made, and how."""

    paths: Annotated[tuple[str, ...], PATHS.option(are_many=True)] = ("input", "orbit", "bullet")
    """Where the camera goes."""
    parts: tuple[Part, ...] = ("all",)
    """What is shown: ``all``. ``background``: without what moves. ``objects``: what moves, alone, on transparent: a WebM (VP9
    with alpha) in color; ``wiggle`` shows them on black. ``objects:2`` or ``objects:1,3``: likewise the objects of these numbers
    alone, as they have them in the masks; the report and ``flowsplat info`` tell which there are."""
    width: int | None = None
    """Pixels; the height follows. None = as the clip was trained."""
    fps: float | None = None
    """Frames a second. None = as the source, in-between frames rendered where the clip was thinned; then ``input`` has
    as many frames as the source, and that is what its rendering costs."""
    slow_motion: float = 1.0
    """How many times slower than it was time plays; the frames between those of the source are rendered. Without sound."""
    max_frames: int = 120
    """Frames of loops (``orbit``, ``bullet``, ``dolly``) at most."""
    orbit_angle: float | None = None
    """Half-width in degrees of the loop of ``orbit`` and ``bullet``, seen from the middle of the scene. None = as far as the clip
    has seen enough and knows where objects are, 3 to 12."""
    bullet_time: float | None = None
    """Seconds of the clip at which time stands still in ``bullet``, ``dolly`` and ``wiggle``. None = the middle."""
    stabilize: float = 0.5
    """Seconds over which ``stabilized`` smooths the path (standard deviation); less where too little image would be left."""
    dolly: float | None = None
    """How many times as far from the subject the camera of ``dolly`` goes; below 1 it comes nearer and widens. None = as far as the
    clip has seen enough, 1.1 to 1.5."""
    stereo: bool = False
    """Every video also as a pair for two eyes, left beside right (``<name>_stereo.mp4``); objects alone stand on black."""
    eye_distance: float = 0.03
    """Between the eyes of ``stereo`` and the ends of ``wiggle``, over the scene's median depth."""
    object_depth: tuple[str, ...] = ()
    """Objects farther from the clip's camera than they were trained, or nearer: each ``number=factor``, as in ``2=1.2 3=0.9``.
    Their sizes go with them, so that the clip's own frames stay as they are, except for which object covers which; other cameras
    see the difference."""
    confidence_fade: bool = False
    """What the clip has not seen well enough to tell what it looks like from where the camera stands fades to black, instead of
    being shown as a guess."""
    camera_file: Path | None = None
    """A camera path of your own: ours, nerfstudio's ``camera_path.json`` or a ``transforms.json``. Its video is
    called ``custom_path_`` and the name of the file."""


def factors_of(distances: Sequence[str]) -> dict[int, float]:
    """By the number of the object, how many times as far away it is to be shown: of ``RenderOptions.object_depth``.

    Raises:
        InputError: one of them cannot be understood, comes twice, or is no distance.
    """
    factors: dict[int, float] = {}
    for text in distances:
        number, _, factor = text.partition("=")
        try:
            value = float(factor)
        except ValueError:
            value = None
        if not number.isdecimal() or value is None:
            raise InputError(f"--render.object-depth {text!r} is none: give object=factor as in 2=1.2.")
        if int(number) in factors:
            raise InputError(f"--render.object-depth names object {number} twice.")
        factors[int(number)] = value
    check_factors(factors)
    return factors


def check_paths(paths: Sequence[str]) -> None:
    """Refuse names that are of no camera path.

    Raises:
        InputError: names the first one.
    """
    if unknown := set(paths) - set(PATHS.names()):
        known = ", ".join(PATHS.names())
        raise InputError(f"Unknown camera path {min(unknown)!r}: choose from {known}, or give a camera file.")


def check_options(options: RenderOptions, fps: float, first: float, last: float) -> None:
    """Refuse what cannot be rendered, before anything is.

    Args:
        fps: frames a second that follow from the options and the source.
        first: seconds of the first frame.
        last: seconds of the last frame.

    Raises:
        InputError: an option has a value that makes no video.
    """
    check_paths(options.paths)
    for part in options.parts:
        numbers_of(part)
    factors_of(options.object_depth)
    if options.width is not None and not _MIN_SIDE <= options.width <= MAX_SIDE:
        raise InputError(f"A video {options.width} pixels wide cannot be made: give a width from {_MIN_SIDE} to {MAX_SIDE}.")
    if not MIN_FPS <= fps <= MAX_FPS:
        raise InputError(f"{fps:g} frames a second cannot be written: give a frame rate from {MIN_FPS:g} to {MAX_FPS:g}.")
    if not 0.01 <= options.slow_motion <= 100:
        raise InputError(
            f"A video {options.slow_motion:g} times slower cannot be made: give --render.slow-motion from 0.01 to 100."
        )
    if not 2 <= options.max_frames <= MAX_FRAMES:
        raise InputError(f"A video of at most {options.max_frames:,} frame(s) cannot be made: give 2 to {MAX_FRAMES:,}.")
    if (count := (last - first) * fps * options.slow_motion) > MAX_FRAMES:
        raise InputError(
            f"A video of {count:,.0f} frames cannot be made, {MAX_FRAMES:,} at most: give a smaller --render.fps or "
            "--render.slow-motion."
        )
    if options.orbit_angle is not None and not 0 <= options.orbit_angle < 90:
        raise InputError(f"The orbit's angle is {options.orbit_angle:g} degrees: give one from 0 to 90.")
    if options.bullet_time is not None and not first <= options.bullet_time <= last:
        raise InputError(f"The bullet time {options.bullet_time:g} s is outside the clip ({first:g} to {last:g} s).")
    if not 0 <= options.stabilize <= 60:
        raise InputError(f"A path cannot be smoothed over {options.stabilize:g} s: give --render.stabilize from 0 to 60.")
    if options.dolly is not None and not 0.25 <= options.dolly <= 4:
        raise InputError(f"A dolly zoom to {options.dolly:g} times the distance cannot be shown: give one from 0.25 to 4.")
    if not 0 < options.eye_distance <= 0.5:
        raise InputError(f"Eyes {options.eye_distance:g} of the depth apart see no depth: give more than 0 and at most 0.5.")
