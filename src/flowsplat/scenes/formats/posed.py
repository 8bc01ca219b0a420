"""Clips that come with calibrated cameras and with pictures by other cameras at the same times."""

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
    ViewPicture,
    resize_labels,
    resize_picture,
    select_frames,
    working_size,
)
from flowsplat.scenes.formats.images import read_picture
from flowsplat.scenes.formats.masks import read_labels
from flowsplat.scenes.scene import HeldoutView

SAME_SHAPE = 0.01
"""Relative difference up to which a picture has the shape that its camera was calibrated with."""


@dataclass(frozen=True)
class PosedPicture:
    """A picture, its camera at the size of the calibration, and the masks of objects and of what the clip saw, if there are any."""

    path: Path
    camera: Camera
    mask: Path | None = None
    covisible: Path | None = None


@dataclass(frozen=True)
class PosedView:
    """A picture by another camera at time ``time`` (a number as in ``open_posed``)."""

    name: str
    time: int
    picture: PosedPicture


@dataclass(kw_only=True)
class PosedClip(Clip):
    """A clip with calibrated cameras.

    Attributes:
        numbers: [T] of the chosen frames in the input.
        pictures: [T] the chosen frames.
        stored_size: (width, height) of all of them.
        others: the pictures by other cameras, with the numbers of their frames.
    """

    numbers: np.ndarray
    pictures: list[PosedPicture]
    stored_size: tuple[int, int]
    others: list[tuple[int, PosedView]]

    @property
    def num_views(self) -> int:
        """Pictures by the other cameras."""
        return len(self.others)

    def frames(self, numbers: Sequence[int]) -> Iterator[np.ndarray]:
        for i in numbers:
            image = read_posed(self.pictures[i])
            if image.shape[1::-1] != self.stored_size:
                raise InputError(
                    f"{self.pictures[i].path} is {image.shape[1]}x{image.shape[0]} pixels, but {self.pictures[0].path} is "
                    f"{self.stored_size[0]}x{self.stored_size[1]}: all pictures must have one size."
                )
            yield resize_picture(image, (self.width, self.height))

    def views(self) -> Iterator[ViewPicture]:
        """The other pictures, brought to the width of the frames where they are larger."""
        for frame, view in self.others:
            picture = view.picture
            image = read_posed(picture)
            share = min(1.0, self.width / image.shape[1])
            size = max(1, round(image.shape[1] * share)), max(1, round(image.shape[0] * share))
            masks = (
                None if path is None else resize_labels((read_labels(path) > 0).astype(np.uint8), size) > 0
                for path in (picture.mask, picture.covisible)
            )
            camera = picture.camera.resized(*size)
            yield ViewPicture(HeldoutView(view.name, frame, camera), resize_picture(image, size), *masks)


def read_posed(picture: PosedPicture) -> np.ndarray:
    """RGB [H, W, 3] uint8.

    Raises:
        InputError: it cannot be read, or has another shape than its camera.
    """
    image, camera = read_picture(picture.path), picture.camera
    height, width = image.shape[:2]
    if abs(width * camera.height / (height * camera.width) - 1) > SAME_SHAPE:
        raise InputError(f"{picture.path} is {width}x{height} pixels, its camera {camera.width}x{camera.height}: another shape.")
    return image


def open_posed(
    folder: Path,
    options: InputOptions,
    pictures: Sequence[PosedPicture],
    views: Sequence[PosedView],
    times: Sequence[int] | None = None,
    notes: Sequence[str] = (),
) -> PosedClip:
    """Choose frames and open the clip; other pictures come along at the times of chosen frames.

    Args:
        folder: of the input, for names and messages.
        pictures: one for every time.
        views: by the other cameras.
        times: rising whole numbers, one a picture; None = 0, 1, 2 ...
        notes: for the user.

    Raises:
        InputError: too few frames, a picture that does not fit its camera, or a camera that is none.
    """
    numbers = np.arange(len(pictures)) if times is None else np.asarray(times)
    for view in views:
        plain_name(view.name, f"{folder}: the held-out view")
    for picture in (*pictures, *(view.picture for view in views)):
        if not picture.camera.is_valid:
            raise InputError(f"The camera of {picture.path} is not finite or not a rotation.")
        if not picture.path.exists():
            raise InputError(f"{picture.path} is missing.")
    selection = select_frames(numbers / options.fps, options, str(folder))
    chosen = [pictures[n] for n in selection.numbers]
    height, width = read_posed(chosen[0]).shape[:2]
    size, resized = working_size(width, height, options, str(folder))
    frame_at = {int(numbers[n]): i for i, n in enumerate(selection.numbers)}
    return PosedClip(
        name=Path(folder).resolve().name,
        source=str(folder),
        width=size[0],
        height=size[1],
        timestamps=selection.timestamps,
        source_fps=options.fps,
        notes=[*selection.notes, *resized, *notes],
        cameras=[picture.camera.resized(*size) for picture in chosen],
        numbers=selection.numbers,
        pictures=chosen,
        stored_size=(width, height),
        others=[(frame_at[view.time], view) for view in views if view.time in frame_at],
    )
