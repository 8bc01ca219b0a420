"""Clips that come with calibrated cameras and with images by other cameras at the same times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import plain_name
from flowsplat.geometry import Camera
from flowsplat.scenes.clip import (
    Clip,
    InputOptions,
    ViewImage,
    choose_working_size,
    resize_image,
    resize_labels,
    select_frames,
)
from flowsplat.scenes.formats.images import read_input_image
from flowsplat.scenes.formats.masks import read_labels
from flowsplat.scenes.scene import HeldoutView

SHAPE_TOLERANCE = 0.01
"""Relative difference up to which an image has the shape that its camera was calibrated with. Chosen by eye."""


@dataclass(frozen=True)
class PosedImage:
    """An image, its camera at the size of the calibration, and the masks of objects and of what the clip saw, if there are any."""

    path: Path
    camera: Camera
    mask: Path | None = None
    covisible: Path | None = None


@dataclass(frozen=True)
class PosedView:
    """An image by another camera at time ``time`` (a number as in ``open_posed``)."""

    name: str
    time: int
    image: PosedImage


@dataclass(kw_only=True)
class PosedClip(Clip):
    """A clip with calibrated cameras.

    Attributes:
        numbers: [T] of the chosen frames in the input.
        images: [T] the chosen frames.
        stored_size: (width, height) of all of them.
        others: the images by other cameras, with the numbers of their frames.
    """

    numbers: np.ndarray
    images: list[PosedImage]
    stored_size: tuple[int, int]
    others: list[tuple[int, PosedView]]

    @property
    def num_views(self) -> int:
        """Images by the other cameras."""
        return len(self.others)

    def frames(self, numbers: Sequence[int]) -> Iterator[np.ndarray]:
        for i in numbers:
            image = read_posed(self.images[i])
            if image.shape[1::-1] != self.stored_size:
                raise InputError(
                    f"{self.images[i].path} is {image.shape[1]}x{image.shape[0]} pixels, but {self.images[0].path} is "
                    f"{self.stored_size[0]}x{self.stored_size[1]}: all images must have one size."
                )
            yield resize_image(image, (self.width, self.height))

    def views(self) -> Iterator[ViewImage]:
        """Yield the other images, brought to the width of the frames where they are larger."""
        for frame, view in self.others:
            posed = view.image
            image = read_posed(posed)
            share = min(1.0, self.width / image.shape[1])
            size = max(1, round(image.shape[1] * share)), max(1, round(image.shape[0] * share))
            masks = (
                None if path is None else resize_labels((read_labels(path) > 0).astype(np.uint8), size) > 0
                for path in (posed.mask, posed.covisible)
            )
            camera = posed.camera.resize(*size)
            yield ViewImage(HeldoutView(view.name, frame, camera), resize_image(image, size), *masks)


def read_posed(posed: PosedImage) -> np.ndarray:
    """Return RGB [H, W, 3] uint8.

    Raises:
        InputError: it cannot be read, or has another shape than its camera.
    """
    image, camera = read_input_image(posed.path), posed.camera
    height, width = image.shape[:2]
    if abs(width * camera.height / (height * camera.width) - 1) > SHAPE_TOLERANCE:
        raise InputError(f"{posed.path} is {width}x{height} pixels, its camera {camera.width}x{camera.height}: another shape.")
    return image


def open_posed(
    folder: Path,
    options: InputOptions,
    images: Sequence[PosedImage],
    views: Sequence[PosedView],
    times: Sequence[int] | None = None,
    notes: Sequence[str] = (),
) -> PosedClip:
    """Choose frames and open the clip; other images come along at the times of chosen frames.

    Args:
        folder: of the input, for names and messages.
        images: one for every time.
        views: by the other cameras.
        times: rising whole numbers, one an image; None = 0, 1, 2 ...
        notes: for the user.

    Raises:
        InputError: too few frames, an image that does not fit its camera, or a camera that is none.
    """
    numbers = np.arange(len(images)) if times is None else np.asarray(times)
    for view in views:
        plain_name(view.name, f"{folder}: the held-out view")
    for image in (*images, *(view.image for view in views)):
        if not image.camera.is_valid:
            raise InputError(f"The camera of {image.path} is not finite or not a rotation.")
        if not image.path.exists():
            raise InputError(f"{image.path} is missing.")
    selection = select_frames(numbers / options.fps, options, str(folder))
    chosen = [images[n] for n in selection.numbers]
    height, width = read_posed(chosen[0]).shape[:2]
    size, resized = choose_working_size(width, height, options, str(folder))
    frame_at = {int(numbers[n]): i for i, n in enumerate(selection.numbers)}
    return PosedClip(
        name=Path(folder).resolve().name,
        source=str(folder),
        width=size[0],
        height=size[1],
        timestamps=selection.timestamps,
        source_fps=options.fps,
        notes=[*selection.notes, *resized, *notes],
        cameras=[image.camera.resize(*size) for image in chosen],
        numbers=selection.numbers,
        images=chosen,
        stored_size=(width, height),
        others=[(frame_at[view.time], view) for view in views if view.time in frame_at],
    )
