"""Black bars round what a clip shows (letterbox, pillarbox): found over its frames and cut off.

A bar is dark, of one color in all frames up to what coding adds, and it ends at the same row everywhere: where it ends, half of the
width shows something in half of the frames. The black sky of a night does not end like that, and is kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

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

    def mask(self, i: int) -> np.ndarray:
        return resize_labels(self._cut(self.whole.mask(i)), (self.width, self.height))


def sample_frames(clip: Clip) -> Iterator[np.ndarray]:
    """Yield some frames of a clip; they are decoded when asked for."""
    return clip.frames(spread(clip.num_frames, COMPARED_FRAMES))


def cut_bars(whole: Clip, options: InputOptions) -> Clip:
    """Return a clip in its own size without its bars, at the working size.

    Raises:
        InputError: too little is left to work with.
    """
    box = find_content(sample_frames(whole))
    left, top, right, bottom = box or (0, 0, whole.width, whole.height)
    shown = right - left, bottom - top
    size, resized = choose_working_size(*shown, options, whole.source)
    notes = [*whole.notes, *resized]
    if box:
        notes.append(
            f"Cut off black bars: {shown[0]}x{shown[1]} of {whole.width}x{whole.height} pixels are left (--crop off keeps all)."
        )
    return CroppedClip(
        name=whole.name, source=whole.source, width=size[0], height=size[1], timestamps=whole.timestamps,
        source_fps=whole.source_fps, notes=notes, audio=whole.audio, audio_start=whole.audio_start,
        has_masks=whole.has_masks, whole=whole, box=(left, top, right, bottom),
    )  # fmt: skip
