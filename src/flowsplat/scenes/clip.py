"""The clip: an input in its own form (video, images, ...), opened, with the frames that were chosen from it.

A format module opens its files as a ``Clip``; ``ingest`` writes any ``Clip`` into a scene folder. Nothing here reads files.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Protocol

import cv2
import numpy as np
from msgspec import Meta

from flowsplat.common.bounds import bounds_in_help, check_bounds
from flowsplat.common.errors import InputError
from flowsplat.common.settings import LEFT_OUT_BY_DEFAULT
from flowsplat.geometry import Camera
from flowsplat.scenes.layers import Depth, Flow, Tracks
from flowsplat.scenes.repeats import FADE_SECONDS, MAX_REPEATS, find_fades, find_repeats, look_size, measure_changes
from flowsplat.scenes.scene import HeldoutView, split_frames

LONG_SIDE = 854
"""Pixels of the long side to which larger input is brought unless the user says otherwise (DAVIS 480p)."""
MIN_SIDE = 32
"""Pixels below which neither flow nor cameras can be estimated. Chosen by eye."""
MAX_SIDE = 8192
"""Pixels of a frame, and the most that can be asked for. Chosen by eye."""
MAX_FRAMES = 100_000
"""Their files are numbered with five digits."""
MIN_FPS, MAX_FPS = 0.01, 1000.0
"""Frames a second that a clip may be said to have. Chosen by eye."""
MAX_NUMBER = 10_000_000
"""The largest number that an option on frames takes. A round number."""
MAX_FRAME_INTERVAL = 0.5
"""Seconds between two kept frames above which the user is told that the motion will hardly be followed. Chosen by eye."""


@bounds_in_help
@dataclass(frozen=True)
class InputOptions:
    """What to take from the input, and what to hold out."""

    start: Annotated[float | None, Meta(ge=0)] = None
    """First second of the input to use; the default is its beginning."""
    end: Annotated[float | None, Meta(gt=0)] = None
    """Last second of the input to use; the default is its end."""
    every: Annotated[int | None, Meta(ge=1, le=MAX_NUMBER)] = None
    """Use one frame in so many; the default is the smallest number that leaves at most max_frames frames."""
    max_frames: Annotated[int, Meta(ge=2, le=MAX_FRAMES)] = 100
    """Use at most so many frames."""
    resize: Annotated[int | None, Meta(ge=0, le=MAX_SIDE)] = None
    """Long side of the frames in pixels, 0 to keep their size; the default is at most 854. Frames are never enlarged."""
    holdout: Annotated[int | None, Meta(ge=2, le=MAX_NUMBER)] = 10
    """Hold one frame in so many out of training, to measure with; none trains on all. Input with held-out cameras trains on all."""
    holdout_frames: tuple[int, ...] = field(default=(), metadata=LEFT_OUT_BY_DEFAULT)
    """Hold out the frames of these numbers, from 0 on, instead; also of input with held-out cameras."""
    sequence: str | None = None
    """Name of the sequence, where the input is the root folder of the DAVIS data set."""
    crop: Literal["auto", "off"] = "auto"
    """Cut black or blurred bars round what videos and folders of images show (letterbox, pillarbox), or keep all."""
    overlay: Literal["auto", "keep"] = "auto"
    """Leave logos, clocks and watermarks, which stay on the screen while the camera moves, out of all that is measured and trained
    (of videos and folders of images), or keep them as part of the scene."""
    fps: Annotated[float, Meta(ge=MIN_FPS, le=MAX_FPS)] = 24.0
    """Frames a second of a folder of images."""
    keep_all: bool = False
    """Keep frames that only repeat the one before, blank frames and fades, which are left out otherwise."""

    def check(self) -> None:
        """Refuse values that make no sense.

        Raises:
            InputError: names the option.
        """
        check_bounds(self, "--")
        if self.end is not None and self.end <= (self.start or 0):
            raise InputError(f"--end {self.end:g} must be later than --start.")
        if self.resize is not None and 0 < self.resize < MIN_SIDE:
            raise InputError(f"--resize {self.resize} must be 0 (keep the size) or from {MIN_SIDE} to {MAX_SIDE:,} pixels.")


@dataclass(frozen=True)
class Selection:
    """Which frames of the input were chosen.

    Attributes:
        numbers: [T] rising numbers of frames in the input.
        timestamps: [T] float64 seconds, the first 0.
        start: seconds of the input's own time at the first chosen frame.
        begin: seconds from the first frame of the input to the first chosen one.
        available: frames from which they were thinned out.
        notes: what was dropped and which option changes it, in sentences for the user.
    """

    numbers: np.ndarray
    timestamps: np.ndarray
    start: float
    begin: float
    available: int
    notes: list[str]


Look = Callable[[np.ndarray], Iterable[np.ndarray | None]]
"""Yields the frames of rising numbers as gray images [h, w] uint8 of ``repeats.look_size``; None where one cannot be read."""


def select_frames(seconds: np.ndarray, options: InputOptions, source: str, look: Look | None = None) -> Selection:
    """Choose frames by time, leave out those that show nothing of their own, then thin out evenly to at most ``max_frames``.

    An automatic ``every`` thins until all of the time span fits; a chosen one is kept, and what does not fit is cut off the end.

    Args:
        seconds: [N] rising, when each frame of the input is shown.
        source: name of the input, for messages.
        look: shows frames; without it, none is left out.

    Raises:
        InputError: fewer than two frames remain.
    """
    seconds = np.asarray(seconds, np.float64)
    if len(seconds) < 2:
        raise InputError(f"{source} has {len(seconds)} frame(s): a moving scene needs at least two frames.")
    elapsed = seconds - seconds[0]
    # Half a millisecond of slack: a time typed with three decimals means the frame that is shown then.
    first, last = (options.start or 0) - 5e-4, (np.inf if options.end is None else options.end) + 5e-4
    inside = np.flatnonzero((elapsed >= first) & (elapsed <= last))
    notes = []
    if len(inside) < len(seconds):
        notes.append(f"Used {len(inside)} of {len(seconds)} frames, chosen by --start and --end.")
    if look is not None and not options.keep_all:
        inside, left_out = _leave_out(inside, elapsed, options, look)
        notes += left_out
    every = _choose_every(len(inside), options)
    thinned = inside[::every]
    numbers = thinned[: options.max_frames]
    if every > 1:
        change = "--every" if options.every else "--every or --max-frames"
        notes.append(f"Kept one frame in {every}, {len(thinned)} of {len(inside)}: change with {change}.")
    if len(numbers) < len(thinned):
        dropped = elapsed[inside[-1]] - elapsed[numbers[-1]]
        notes.append(f"Cut off the last {dropped:.1f} seconds, to {len(numbers)} frames: change with --every or --max-frames.")
    if len(numbers) < 2:
        raise InputError(
            f"{source}: {len(numbers)} of {len(seconds)} frames over {elapsed[-1]:.3g} seconds remain, but a moving scene needs "
            "at least two frames: change --start, --end or --every."
        )
    widest = float(np.diff(elapsed[numbers]).max())
    if widest > MAX_FRAME_INTERVAL:
        notes.append(
            f"Kept frames are up to {widest:.1f} seconds apart, which is wide for following motion: "
            "choose a shorter piece with --start and --end."
        )
    return Selection(
        numbers, elapsed[numbers] - elapsed[numbers[0]], float(seconds[numbers[0]]), float(elapsed[numbers[0]]), len(inside), notes
    )


def _choose_every(count: int, options: InputOptions) -> int:
    return options.every or max(1, -(-count // options.max_frames))


def _leave_out(inside: np.ndarray, elapsed: np.ndarray, options: InputOptions, look: Look) -> tuple[np.ndarray, list[str]]:
    """Return the numbers of ``inside`` without blank frames, fades and repeats, and what is said of those.

    What is thinned so far that no repeat can be chosen beside its twin is looked at only where fades are, at both ends.
    """
    if len(inside) < 2:
        return inside, []
    times = elapsed[inside]
    thinned = _choose_every(len(inside), options) > MAX_REPEATS
    looked = (np.minimum(times - times[0], times[-1] - times) <= FADE_SECONDS) | (not thinned)
    found = measure_changes(look(inside[looked]), int(looked.sum()))
    contrasts = np.full(len(inside), np.inf)
    contrasts[looked] = found.contrasts
    faded = find_fades(contrasts, times)
    repeated = np.zeros(len(inside), bool) if thinned else find_repeats(found.steps) & ~faded
    if (~faded & ~repeated).sum() < 2:
        return inside, []
    notes = []
    if faded.any():
        notes.append(f"Left out {faded.sum()} of {len(inside)} frames, which are blank or fade: keep them with --keep-all.")
    if repeated.any():
        notes.append(
            f"Left out {repeated.sum()} of {len(inside)} frames, which only repeat the one before, as a change of the frame rate "
            "leaves them: keep them with --keep-all."
        )
    return inside[~faded & ~repeated], notes


def choose_working_size(width: int, height: int, options: InputOptions, source: str) -> tuple[tuple[int, int], list[str]]:
    """Return ((width, height) to work at, notes for the user).

    Raises:
        InputError: too small to work with.
    """
    long_side = LONG_SIDE if options.resize is None else options.resize
    scale = min(1.0, long_side / max(width, height)) if long_side else 1.0
    size = max(1, round(width * scale)), max(1, round(height * scale))
    if min(size) < MIN_SIDE:
        raise InputError(
            f"{source}: frames of {size[0]}x{size[1]} pixels are too small: both sides must have {MIN_SIDE} pixels or more."
        )
    if size == (width, height):
        return size, []
    return size, [f"Resized from {width}x{height} to {size[0]}x{size[1]}: change with --resize."]


def resize_image(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Bring an image [H, W] or [H, W, C] to (width, height): the mean over areas when it shrinks, cubic when it grows."""
    if image.shape[1::-1] == size:
        return image
    shrinks = size[0] <= image.shape[1] and size[1] <= image.shape[0]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


def resize_labels(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Bring masks, depth or flow [H, W] or [H, W, C] to (width, height) without mixing values of neighbors."""
    if image.shape[1::-1] == size:
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_NEAREST_EXACT)


class Truth(Protocol):
    """What is known exactly about a rendered clip, by the numbers of its chosen frames and at its working size."""

    @property
    def cameras(self) -> Sequence[Camera]:
        """One camera a frame."""

    @property
    def flow_pairs(self) -> Sequence[tuple[int, int]]:
        """The pairs of frames between which flow is known."""

    @property
    def tracks(self) -> Tracks:
        """Points [P, T, 3] in the world."""

    def depth(self, i: int) -> Depth:
        """Return depth of frame ``i``."""

    def flow(self, i: int, j: int) -> Flow:
        """Return flow between a pair of ``flow_pairs``."""

    def mask(self, i: int) -> np.ndarray:
        """Return [H, W] object numbers of frame ``i``, 0 = background."""


@dataclass(frozen=True)
class ViewImage:
    """An image by another camera: RGB [H, W, 3] uint8, and [H, W] bool objects and pixels that the clip saw, where known."""

    view: HeldoutView
    image: np.ndarray
    mask: np.ndarray | None = None
    covisible: np.ndarray | None = None


@dataclass(kw_only=True)
class Clip(ABC):
    """An opened input. Frame ``i`` counts the chosen frames; images are read when asked for, never all at once.

    Attributes:
        name: short name for files and titles.
        source: where it came from, for provenance.
        width: pixels of the frames as they are delivered.
        height: pixels.
        timestamps: [T] float64 seconds, rising, the first 0.
        source_fps: frames a second of the input, dropped frames included.
        notes: what was dropped or converted and which option changes it, in sentences for the user.
        audio: file with the sound that belongs to the clip.
        audio_start: seconds in that file's presentation time at which the clip starts.
        begin: seconds from the first frame of the input to that of the clip, as ``--start`` counts them.
        available: frames of the input that the chosen ones were thinned out from; None where they were not.
        has_masks: whether masks came with the input.
        truth: what is known exactly.
        cameras: [T] calibrated ones that came with the input, in the coordinates of its views and at the working size.
    """

    name: str
    source: str
    width: int
    height: int
    timestamps: np.ndarray
    source_fps: float
    notes: list[str] = field(default_factory=list)
    audio: Path | None = None
    audio_start: float = 0.0
    begin: float = 0.0
    available: int | None = None
    has_masks: bool = False
    truth: Truth | None = None
    cameras: Sequence[Camera] | None = None

    @property
    def num_frames(self) -> int:
        """Chosen frames."""
        return len(self.timestamps)

    def holdout(self, options: InputOptions) -> int | None:
        """Return every how many frames one is held out; None = none. Images by other cameras are a better test than held-out
        frames, and truth has flow between neighbors only."""
        return None if self.num_views else options.holdout

    def split(self, options: InputOptions) -> tuple[list[int], list[int]]:
        """Return (training, held-out) frame numbers.

        Raises:
            InputError: as ``split_frames``.
        """
        return split_frames(self.num_frames, self.holdout(options), options.holdout_frames)

    @property
    def num_views(self) -> int:
        """Images by other cameras; where there are any, they are the test, and no frame is held out."""
        return 0

    @abstractmethod
    def frames(self, numbers: Sequence[int]) -> Iterator[np.ndarray]:
        """Yield the images RGB [H, W, 3] uint8 of the frames ``numbers``, which rise.

        Raises:
            InputError: an image cannot be read.
        """

    def look(self) -> Iterator[np.ndarray | None]:
        """Yield all frames as gray images [h, w] uint8 of ``repeats.look_size``; None where one cannot be read."""
        size = look_size(self.width, self.height)
        for image in self.frames(range(self.num_frames)):
            yield resize_image(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), size)

    def mask(self, i: int) -> np.ndarray:
        """Return [H, W] uint8: object numbers of frame ``i``, 0 = background; only where ``has_masks``."""
        raise LookupError(f"{self.source} came without masks")

    def views(self) -> Iterator[ViewImage]:
        """Yield images by other cameras at the times of chosen frames."""
        return iter(())
