"""Bars round what a clip shows (letterbox, pillarbox), black or blurred: found over its frames and cut off.

A black bar is dark, of one color in all frames up to what coding adds, and it ends at the same row everywhere: where it ends, half
of the width shows something in half of the frames. The black sky of a night does not end like that, and is kept.

Blurred bars have hardly any detail, end at one column in all frames, and are an enlarged copy of what lies between them or change
along with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from flowsplat.common.spread import spread
from flowsplat.scenes.clip import Clip, InputOptions, choose_working_size, resize_image, resize_labels

COMPARED_FRAMES = 24
"""Frames in which bars are looked for. Chosen by eye."""
MAX_BAR_LEVEL, MAX_BAR_NOISE, MIN_CONTENT_STEP = 40, 16, 24
"""Levels of 255: of the color of a bar at most; by which coding changes it; and by which what is shown differs from it. Chosen by
eye."""
MAX_NOISY_SHARE, MIN_CONTENT_SHARE = 0.02, 0.5
"""Share of a row of a bar that may differ from its color, and of the first row beside it (and of the frames) that
does. Chosen by eye."""
MAX_RAMP = 8
"""Rows between the two, which coding smears: a block of JPEG."""
MIN_BAR_SHARE = 0.01
"""Share of the side of the image that each of two bars has at least. Chosen by eye."""
MIN_BLURRED_SHARE, MAX_UNEVEN_SHARE = 0.05, 0.02
"""Share of the side of the image that each of two blurred bars has at least, and by which the two may differ. Chosen by eye."""
MAX_BLURRED_DETAIL, MIN_SHARP_DETAIL = 0.4, 0.6
"""Steps from column to column in a blurred bar at most, and where it ends at least, over those of the middle half. At .3 bars of
light blurs are kept (4 of 42 instead of 3), at .4 no other clip passes (docs/given.md)."""
BLURRED_RAMP = 3
"""Columns within which the one becomes the other: what coding smears. Chosen by eye."""
COMPARED_BLUR = 0.03
"""Standard deviation, over the longer side, of the blur under which a bar is compared with the enlarged copy: the blur that it has
is not known. Chosen by eye."""
ENLARGEMENTS = (1.0, 1.25, 1.5)
"""By how much more than to fill the image the copy may be enlarged. Chosen by eye."""
MIN_COPY_CORRELATION = 0.85
"""Correlation of blurred bars with the copy, in the median frame: .96 to 1 of bars made of bear, lucia and workshop, .2 to .7 of
other images."""
MIN_BAR_CHANGE, MIN_CHANGE_RATIO = 3.0, 0.25
"""Gray levels by which blurred bars change over the clip (standard deviation of a pixel), and that over the change of the middle
under the same blur, which is .4 to 2.4 there."""

Box = tuple[int, int, int, int]
"""Left, top, right and bottom of what is shown, in pixels."""


def find_content(images: Iterable[np.ndarray]) -> Box | None:
    """Return what lies between bars above and below, left and right, or both; None where there are none.

    Args:
        images: RGB [H, W, 3] uint8, all of one size; no more are taken than it needs to see that there are no bars.
    """
    reached, shown, count = np.zeros((0, 0), np.int16), np.zeros((0, 0), np.int16), 0
    color = np.zeros(3)
    for image in images:
        if not count:
            reached, shown = np.zeros((2, *image.shape[:2]), np.int16)
            color = np.median(image[[0, 0, -1, -1], [0, -1, 0, -1]], axis=0)
            if color.max() > MAX_BAR_LEVEL:
                return None
        off = np.abs(image - color).max(-1).astype(np.int16)
        np.maximum(reached, off, out=reached)
        shown += off > MIN_CONTENT_STEP
        count += 1
        if not any(_is_quiet(border).all() for border in (reached[[0, -1]], reached[:, [0, -1]].T)):
            return None
    if not count:
        return None
    often = shown >= MIN_CONTENT_SHARE * count
    top, bottom = _find_ends(reached, often)
    left, right = _find_ends(reached[top:bottom].T, often[top:bottom].T)
    if (left, right) != (0, reached.shape[1]):  # bars left and right hide where those above and below end
        top, bottom = _find_ends(reached[:, left:right], often[:, left:right])
    box = left, top, right, bottom
    return None if box == (0, 0, *reached.shape[::-1]) else box


def _is_quiet(reached: np.ndarray) -> np.ndarray:
    return (reached > MAX_BAR_NOISE).mean(1) <= MAX_NOISY_SHARE


def _find_ends(reached: np.ndarray, often: np.ndarray) -> tuple[int, int]:
    """Return the first row and the one after the last between two bars; all rows where there are not two.

    Args:
        reached: [H, W] by how much the color of a bar was missed, at most.
        often: [H, W] whether something else is shown in many frames.
    """
    height = len(reached)
    quiet, shows = _is_quiet(reached), often.mean(1) >= MIN_CONTENT_SHARE
    ends = []
    for is_quiet, is_shown in ((quiet, shows), (quiet[::-1], shows[::-1])):
        bar = int(np.argmin(is_quiet))  # 0 too where all are quiet
        ramp = np.flatnonzero(is_shown[bar : bar + MAX_RAMP + 1])
        if bar < MIN_BAR_SHARE * height or not len(ramp):
            return 0, height
        ends.append(bar + int(ramp[0]))
    return ends[0], height - ends[1]


def find_sharp_content(images: Iterable[np.ndarray]) -> Box | None:
    """Return what lies between two blurred bars, left and right or above and below; None where there are none.

    Args:
        images: RGB [H, W, 3] uint8, all of one size; no more are taken than it needs to see that there are no bars.
    """
    grays: list[np.ndarray] = []
    for image in images:
        grays.append(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32))
        if len(grays) == 1 and not any(_has_blurred_rims(gray) for gray in (grays[0], grays[0].T)):
            return None
    if not grays:
        return None
    height, width = grays[0].shape
    columns = _find_sharp_columns(grays)
    if columns and _are_blurred_bars(grays, *columns):
        return columns[0], 0, columns[1], height
    turned = [gray.T for gray in grays]
    rows = _find_sharp_columns(turned)
    if rows and _are_blurred_bars(turned, *rows):
        return 0, rows[0], width, rows[1]
    return None


def _measure_steps(gray: np.ndarray) -> tuple[np.ndarray, float]:
    """Return [W - 1] the mean step in gray levels from column to column, and the median of the middle half."""
    steps = np.abs(np.diff(gray, axis=1)).mean(0)
    quarter = len(steps) // 4
    return steps, float(np.median(steps[quarter : len(steps) - quarter]))


def _has_blurred_rims(gray: np.ndarray) -> bool:
    """Return whether the columns along both sides have hardly any detail."""
    steps, detail = _measure_steps(gray)
    rim = max(1, round(MIN_BLURRED_SHARE * len(steps)) - BLURRED_RAMP)
    return bool(max(steps[:rim].max(), steps[-rim:].max()) <= MAX_BLURRED_DETAIL * detail)


def _find_sharp_columns(grays: Sequence[np.ndarray]) -> tuple[int, int] | None:
    """Return the first column with detail and the one after the last, where those outside have hardly any."""
    measured = [_measure_steps(gray) for gray in grays]
    steps, detail = np.median([each for each, _ in measured], axis=0), float(np.median([each for _, each in measured]))
    width, ends = len(steps) + 1, []
    for walk in (steps, steps[::-1]):
        sharp = walk >= MIN_SHARP_DETAIL * detail
        first = int(np.argmax(sharp))
        outside = walk[: max(0, first - BLURRED_RAMP)]
        if not sharp.any() or first < MIN_BLURRED_SHARE * width or (outside > MAX_BLURRED_DETAIL * detail).any():
            return None
        ends.append(first + 1 + int(np.argmax(walk[first : first + BLURRED_RAMP])))
    left, right = ends[0], width - ends[1]
    return (left, right) if abs(ends[0] - ends[1]) <= MAX_UNEVEN_SHARE * width + 1 and right - left > 1 else None


def _are_blurred_bars(grays: Sequence[np.ndarray], left: int, right: int) -> bool:
    """Return whether what lies outside of two columns is a blurred image of the same clip, and no frame or wall at both sides.

    It is an enlarged copy of the middle, or it changes along with it: what is fixed to the camera does not change, and what is not
    would not end at one column.
    """
    height, width = grays[0].shape
    sigma = COMPARED_BLUR * max(height, width)

    def blur(image: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(np.ascontiguousarray(image), (0, 0), sigma)

    def outside(gray: np.ndarray) -> np.ndarray:
        sides = gray[:, : left - BLURRED_RAMP], gray[:, right + BLURRED_RAMP :]
        return np.concatenate([blur(side).ravel() for side in sides])

    def copies(middle: np.ndarray) -> Iterator[np.ndarray]:
        yield cv2.resize(middle, (width, height))
        for enlargement in ENLARGEMENTS:
            scale = enlargement * width / middle.shape[1]
            large = cv2.resize(middle, (round(scale * middle.shape[1]), round(scale * height)))
            top, start = (large.shape[0] - height) // 2, (large.shape[1] - width) // 2
            yield large[top : top + height, start : start + width]

    middles = [np.ascontiguousarray(gray[:, left:right]) for gray in grays]
    bars = [outside(gray) for gray in grays]
    changes = [float(np.std(images, axis=0).mean()) for images in (bars, [blur(middle) for middle in middles])]
    if changes[0] >= max(MIN_BAR_CHANGE, MIN_CHANGE_RATIO * changes[1]):
        return True
    likeness = [[_correlate(bar, outside(copy)) for copy in copies(middle)] for bar, middle in zip(bars, middles, strict=True)]
    return bool(np.median(likeness, axis=0).max() >= MIN_COPY_CORRELATION)


def _correlate(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-6))


@dataclass(kw_only=True)
class CroppedClip(Clip):
    """What ``box`` holds of a clip that is delivered in its own size."""

    whole: Clip
    box: Box

    def _cut(self, image: np.ndarray) -> np.ndarray:
        left, top, right, bottom = self.box
        return np.ascontiguousarray(image[top:bottom, left:right])

    def frames(self, numbers: Sequence[int]) -> Iterator[np.ndarray]:
        for image in self.whole.frames(numbers):
            yield resize_image(self._cut(image), (self.width, self.height))

    def look(self) -> Iterator[np.ndarray | None]:
        for image in self.whole.look():
            if image is None:
                yield None
                continue
            scale = np.tile(np.array(image.shape[::-1]) / (self.whole.width, self.whole.height), 2)
            left, top, right, bottom = np.rint(self.box * scale).astype(int)
            yield np.ascontiguousarray(image[top:bottom, left:right])

    def mask(self, i: int) -> np.ndarray:
        return resize_labels(self._cut(self.whole.mask(i)), (self.width, self.height))


def sample_frames(clip: Clip) -> Iterator[np.ndarray]:
    """Yield some frames of a clip; they are decoded when asked for."""
    return clip.frames(spread(clip.num_frames, COMPARED_FRAMES))


def find_bars(clip: Clip) -> tuple[Literal["black", "blurred"], Box] | None:
    """Return what bars a clip has, and what lies between them; None where it has none."""
    box = find_content(sample_frames(clip))
    if box:
        return "black", box
    box = find_sharp_content(sample_frames(clip))
    return ("blurred", box) if box else None


def cut_bars(whole: Clip, options: InputOptions) -> Clip:
    """Return a clip in its own size without its bars, at the working size.

    Raises:
        InputError: too little is left to work with.
    """
    found = find_bars(whole)
    left, top, right, bottom = found[1] if found else (0, 0, whole.width, whole.height)
    shown = right - left, bottom - top
    size, resized = choose_working_size(*shown, options, whole.source)
    notes = [*whole.notes, *resized]
    if found:
        left_over = f"{shown[0]}x{shown[1]} of {whole.width}x{whole.height} pixels are left"
        notes.append(f"Cut off {found[0]} bars: {left_over} (--crop off keeps all).")
    return CroppedClip(
        name=whole.name, source=whole.source, width=size[0], height=size[1], timestamps=whole.timestamps,
        source_fps=whole.source_fps, notes=notes, audio=whole.audio, audio_start=whole.audio_start,
        begin=whole.begin, available=whole.available, has_masks=whole.has_masks, whole=whole, box=(left, top, right, bottom),
    )  # fmt: skip
