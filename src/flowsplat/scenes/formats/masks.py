"""Masks that come with images: black is background, and every other color is a moving object.

Black and white, gray object numbers, colors and palettes (DAVIS) all work; alpha is ignored. The colors of a clip become the
numbers 1, 2, ... in one order for all frames, which for the palette of DAVIS is its own. Where a clip has more colors than
objects can be (soft edges, JPEG), all that is not black is one object.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.scenes.clip import resize_labels
from flowsplat.scenes.layers import decode_image

MAX_OBJECTS = 32
"""Colors above which they are taken for shades of one object. Chosen by eye."""
JPEG_BLACK = 127
"""Up to this value a pixel of a JPEG mask is background: compression smears its edges. Chosen by eye."""


def read_labels(path: Path) -> np.ndarray:
    """Return [H, W] int32: the color of each pixel, packed, of gray images too; 0 = background. 16-bit gray is a number as it is.

    A label means the same in every image of a clip, whatever else is seen in it.

    Raises:
        InputError: missing or not an image.
    """
    image = decode_image(path, cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path} is no readable mask: save masks as 8-bit PNG.")
    if image.ndim == 2 or image.shape[2] <= 2:
        labels = (image if image.ndim == 2 else image[..., 0]).astype(np.int32)
        labels = labels * 0x010101 if image.dtype == np.uint8 else labels
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
    """The masks of a clip by name, and the ``colors`` (sorted labels) that became the objects 1, 2, ...; None: all one object."""

    paths: Mapping[str, Path]
    colors: np.ndarray | None

    @staticmethod
    def scan(paths: Mapping[str, Path], size: tuple[int, int]) -> GivenMasks:
        """Read every mask once, to check its size (width, height) and to number the objects of the clip.

        Raises:
            InputError: a mask cannot be read or has another size.
        """
        colors = np.zeros(0, np.int32)
        for path in paths.values():
            labels = read_labels(path)
            if labels.shape != size[::-1]:
                raise InputError(
                    f"{path} is {labels.shape[1]}x{labels.shape[0]} pixels, but its image is {size[0]}x{size[1]}: "
                    "masks must have the size of their images."
                )
            if len(colors) <= MAX_OBJECTS:
                colors = np.union1d(colors, labels[labels > 0])
        return GivenMasks(paths, colors if len(colors) <= MAX_OBJECTS else None)

    def read(self, name: str, size: tuple[int, int]) -> np.ndarray:
        """Return [H, W] uint8 object numbers at ``size`` (width, height), 0 = background."""
        labels = read_labels(self.paths[name])
        if self.colors is None:
            objects = (labels > 0).astype(np.uint8)
        else:
            objects = np.where(labels > 0, np.searchsorted(self.colors, labels) + 1, 0).astype(np.uint8)
        return resize_labels(objects, size)
