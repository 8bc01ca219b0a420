"""Masks that come with images: black is background, and every other color is a moving object.

Black and white, gray object numbers, colors and palettes (DAVIS) all work; alpha is ignored, and EXIF turns them as it turns
images. The colors of a clip become the numbers 1, 2, ... in one order for all frames, which for the palette of DAVIS is its own.
Where a clip has more colors than objects can be (soft edges, JPEG), all that is not black is one object. The label 255 beside
object numbers means that nobody knows ("void", as in DAVIS and Pascal VOC), and is no object.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.progress import report
from flowsplat.scenes.clip import resize_labels
from flowsplat.scenes.layers import decode_image, find_turn

MAX_OBJECTS = 32
"""Colors above which they are taken for shades of one object. Chosen by eye."""
MAX_MOVING_SHARE, MAX_RIM_SHARE = 0.5, 0.75
"""Shares of the image, and of its rim, that half of the masks may hold at most, both together: what moves may fill the image, but
something of what rests is seen along its rim. Chosen by eye."""
GRAY = 0x010101
"""A label of gray value 1."""
VOID_COLOR, VOID_GRAY = 0xC0E0E0, 255 * GRAY
"""Labels of 255 in the palette of DAVIS and Pascal VOC, and in gray images."""
JPEG_BLACK = 127
"""Up to this value a pixel of a JPEG mask is background: compression smears its edges. Chosen by eye."""


Turn = Callable[[np.ndarray], np.ndarray]
"""Brings an image upright."""


def read_labels(path: Path) -> np.ndarray:
    """Return [H, W] int32: the color of each pixel, packed, of gray images too; 0 = background. 16-bit gray is a number as it is.

    A label means the same in every image of a clip, whatever else is seen in it.

    Raises:
        InputError: missing or not an image.
    """
    return unpack_labels(path, decode_image(path, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH))


def unpack_labels(path: Path, image: np.ndarray | None) -> np.ndarray:
    """Return what ``read_labels`` does from the image that OpenCV read from ``path``; None is no image.

    Raises:
        InputError: it is none.
    """
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path} is no readable mask: save masks as 8-bit PNG.")
    if image.ndim == 2 or image.shape[2] <= 2:
        labels = (image if image.ndim == 2 else image[..., 0]).astype(np.int32)
        labels = labels * GRAY if image.dtype == np.uint8 else labels
    else:
        image = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)  # three numbers have to fit in one
        # In this order the colors of DAVIS rank as its object numbers.
        labels = image[..., 0].astype(np.int32) << 16 | image[..., 1].astype(np.int32) << 8 | image[..., 2]
    if path.suffix.lower() in (".jpg", ".jpeg"):
        brightest = image if image.ndim == 2 else image[..., :3].max(-1)
        labels = (brightest > JPEG_BLACK).astype(np.int32)
    return labels


@dataclass(frozen=True)
class GivenMasks:
    """The masks of a clip.

    Attributes:
        paths: by name.
        colors: [n] sorted labels that became the objects 1, 2, ...; None: all one object.
        void: labels that mean that nobody knows.
        turns: how masks are brought upright that were stored as their images are, where these are turned by EXIF.
        labels: reads the labels of a path.
    """

    paths: Mapping[str, Path]
    colors: np.ndarray | None
    void: tuple[int, ...] = ()
    turns: Mapping[str, Turn] = field(default_factory=dict)
    labels: Callable[[Path], np.ndarray] = read_labels

    @staticmethod
    def scan(
        paths: Mapping[str, Path], size: tuple[int, int], images: Mapping[str, Path] | None = None,
        read: Callable[[Path], np.ndarray] = read_labels,
    ) -> GivenMasks:  # fmt: skip
        """Read every mask once, to check its size (width, height) and to number the objects of the clip.

        Args:
            images: the images that the masks belong to, by name, where they are at hand. What has their size before EXIF turns
                them is turned as they are.
            read: labels [H, W] int32 of a path, 0 = background; paths may be of parts of a file.

        Raises:
            InputError: a mask cannot be read or has another size.
        """
        colors, turns = np.zeros(0, np.int32), {}
        for name, path in paths.items():
            labels = read(path)
            if labels.shape == size != size[::-1] and images is not None:
                turns[name] = find_turn(images[name])
                labels = turns[name](labels)
            if labels.shape != size[::-1]:
                raise InputError(
                    f"{path} is {labels.shape[1]}x{labels.shape[0]} pixels, but its image is {size[0]}x{size[1]}: "
                    "masks must have the size of their images."
                )
            if len(colors) <= MAX_OBJECTS:
                colors = np.union1d(colors, labels[labels > 0])
        if len(colors) > MAX_OBJECTS:
            return GivenMasks(paths, None, turns=turns, labels=read)
        void = find_void(colors)
        return GivenMasks(paths, np.setdiff1d(colors, void), void, turns, read)

    def read(self, name: str, size: tuple[int, int]) -> np.ndarray:
        """Return [H, W] uint8 object numbers at ``size`` (width, height), 0 = background."""
        labels = self.turns.get(name, np.asarray)(self.labels(self.paths[name]))
        if self.colors is None:
            objects = (labels > 0).astype(np.uint8)
        else:
            objects = np.where(np.isin(labels, self.colors), np.searchsorted(self.colors, labels) + 1, 0).astype(np.uint8)
        return resize_labels(objects, size)

    def read_moving(self, path: Path, size: tuple[int, int]) -> np.ndarray:
        """Return [H, W] uint8 at ``size`` (width, height) of a mask of the same clip: 1 for what moves, of whatever label."""
        labels = self.labels(path)
        return resize_labels(((labels > 0) & ~np.isin(labels, self.void)).astype(np.uint8), size)


def find_void(colors: np.ndarray) -> tuple[int, ...]:
    """Return which of the labels of a clip are 255, beside numbers of objects: alone it is what moves."""
    others = colors[~np.isin(colors, (VOID_COLOR, VOID_GRAY))]
    numbers = len(others) > 0 and bool(((others % GRAY == 0) & (others // GRAY <= MAX_OBJECTS)).all())
    void = [VOID_COLOR] * (len(others) > 0) + [VOID_GRAY] * numbers
    return tuple(label for label in void if label in colors)


def require_rest(source: str, masks: Sequence[np.ndarray]) -> None:
    """Refuse masks [H, W] that look inverted, and say where nothing rests by them at all.

    Raises:
        InputError: most of them hold most of the image and of its rim, but not all of it.
    """
    moving = [mask > 0 for mask in masks]
    share = float(np.median([mask.mean() for mask in moving]))
    rim = float(np.median([np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean() for mask in moving]))
    if share <= MAX_MOVING_SHARE or rim <= MAX_RIM_SHARE:
        return
    advice = (
        "black is what rests and every other color an object. Invert masks whose objects are black, and give masks alone, not "
        "images with masks laid over them."
    )
    if all(mask.all() for mask in moving):
        report(f"By the masks of {source} everything moves, and nothing rests to find cameras by: {advice}")
        return
    raise InputError(
        f"By the masks of {source} {share:.0%} of the image moves, and {rim:.0%} of its rim, so that hardly anything rests to find "
        f"cameras by: {advice}"
    )
