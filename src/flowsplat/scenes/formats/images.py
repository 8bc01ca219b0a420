"""Folders of images, with masks or without."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.spread import spread
from flowsplat.scenes.clip import Clip, InputOptions, choose_working_size, resize_image, select_frames
from flowsplat.scenes.formats.masks import GivenMasks
from flowsplat.scenes.layers import decode_image, find_turn
from flowsplat.scenes.repeats import look_size

_EIGHT_BITS = np.rint(np.arange(65536) / 257).astype(np.uint8)
COMPARED_ALPHAS = 3
"""Images in whose alpha is looked. Chosen by eye."""
ALPHA_SUFFIXES = {".png", ".webp", ".tif", ".tiff"}
IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"}


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Sort key under which ``frame9`` comes before ``frame10``."""
    parts = re.split(r"([0-9]+)", path.name.casefold())
    # Numbers by their length and their digits: Python refuses to read very long ones.
    return [(len(part.lstrip("0")), part.lstrip("0")) if k % 2 else (-1, part) for k, part in enumerate(parts)]


def list_images(folder: Path) -> list[Path]:
    """Return the images in a folder in natural order; hidden files and folders are left out."""
    found = [p for p in Path(folder).iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.name[0] != "." and p.is_file()]
    return sorted(found, key=natural_key)


def is_animated(path: Path) -> bool:
    """Return whether a file is an animated WebP (https://developers.google.com/speed/webp/docs/riff_container)."""
    with path.open("rb") as file:
        head = file.read(21)
    return head[:4] == b"RIFF" and head[8:16] == b"WEBPVP8X" and len(head) == 21 and bool(head[20] & 2)


def read_input_image(path: Path) -> np.ndarray:
    """Any image as RGB [H, W, 3] uint8: turned upright by its EXIF tag, 16 bits reduced to 8, alpha dropped.

    Raises:
        InputError: missing, empty, damaged, or with floating-point values.
    """
    image = decode_image(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if image is None:
        raise InputError(f"{path} is missing, empty, damaged or not an image: replace or remove it.")
    if image.dtype == np.uint16:
        image = _EIGHT_BITS[image]
    if image.dtype != np.uint8:
        raise InputError(f"{path} has {image.dtype} values: save images with 8 or 16 bits a channel.")
    return np.ascontiguousarray(image[..., ::-1])


def _look(paths: Sequence[Path]) -> Iterator[np.ndarray | None]:
    """Yield small gray images, None for files that are no images: those that are chosen are refused later."""
    for path in paths:
        try:
            gray = cv2.cvtColor(read_input_image(path), cv2.COLOR_RGB2GRAY)
        except InputError:
            yield None
        else:
            yield resize_image(gray, look_size(gray.shape[1], gray.shape[0]))


@dataclass(kw_only=True)
class ImagesClip(Clip):
    """Chosen images of a folder: ``paths`` [T], all of ``stored_size`` (width, height), with ``masks`` where given."""

    paths: list[Path]
    stored_size: tuple[int, int]
    masks: GivenMasks | None = None

    def frames(self, numbers: Sequence[int]) -> Iterator[np.ndarray]:
        for i in numbers:
            image = read_input_image(self.paths[i])
            size = image.shape[1], image.shape[0]
            if size != self.stored_size:
                raise InputError(
                    f"{self.paths[i]} is {size[0]}x{size[1]} pixels, but {self.paths[0]} is "
                    f"{self.stored_size[0]}x{self.stored_size[1]}: all images must have one size."
                )
            yield resize_image(image, (self.width, self.height))

    def mask(self, i: int) -> np.ndarray:
        if self.masks is None:
            return super().mask(i)
        return self.masks.read(self.paths[i].stem, (self.width, self.height))


def _note_alpha(paths: Sequence[Path]) -> list[str]:
    """Return a sentence for the user where images are transparent somewhere."""
    for path in paths:
        if path.suffix.lower() in ALPHA_SUFFIXES:
            image = decode_image(path, cv2.IMREAD_UNCHANGED)
            if image is not None and image.ndim == 3 and image.shape[2] == 4 and image[..., 3].min() < np.iinfo(image.dtype).max:
                return [
                    "The images are transparent in parts: their alpha is left out, and the colors under it are taken. If it says "
                    "what moves, save it as black and white images, and name their folder with --given.masks."
                ]
    return []


def _note_turned(image: Path, mask: Path, masks: GivenMasks, is_square: bool) -> list[str]:
    """Return a sentence for the user where EXIF turns an image, but not its mask, and sizes do not tell whether it should."""
    if mask.stem in masks.turns:
        return ["Masks were turned as EXIF turns their images."]
    probe = np.arange(6).reshape(2, 3)
    turned = find_turn(image)(probe)
    sizes_tell = turned.shape != probe.shape and not is_square
    if sizes_tell or np.array_equal(turned, probe) or not np.array_equal(find_turn(mask)(probe), probe):
        return []
    return ["EXIF turns the images, and their masks are taken as they are: turn these, too, if they lie the other way round."]


def open_images(folder: Path, options: InputOptions, masks: Path | None = None, *, name: str | None = None) -> ImagesClip:
    """Open a folder of images.

    Args:
        masks: a folder with one mask for every image, of the same name and size.
        name: name of the clip; the default is the folder's.

    Raises:
        InputError: no images, fewer than two frames to use, or masks that do not fit.
    """
    paths = list_images(folder)
    if not paths:
        raise InputError(f"{folder} has no images (jpg, png, webp, tiff or bmp).")
    stems: dict[str, Path] = {}
    for path in paths:
        if path.stem in stems:
            raise InputError(f"{path} and {stems[path.stem]} have the same name: keep only one of them.")
        stems[path.stem] = path
    seconds = np.arange(len(paths)) / options.fps
    selection = select_frames(seconds, options, str(folder), lambda numbers: _look([paths[n] for n in numbers]))
    chosen = [paths[i] for i in selection.numbers]
    height, width = read_input_image(chosen[0]).shape[:2]
    size, notes = choose_working_size(width, height, options, str(folder))
    given = None
    if masks is not None:
        found = {path.stem: path for path in list_images(masks)}
        for stem in stems:
            if stem not in found:
                raise InputError(f"{masks} has no mask for {stems[stem].name}: give one for every image, or none.")
        for stem, path in found.items():
            if stem not in stems:
                raise InputError(f"{path} belongs to no image in {folder}: remove it, or name it like its image.")
        images = {path.stem: path for path in chosen}
        given = GivenMasks.scan({stem: found[stem] for stem in images}, (width, height), images)
        notes += _note_turned(chosen[0], found[chosen[0].stem], given, width == height)
    notes += _note_alpha([chosen[k] for k in spread(len(chosen), COMPARED_ALPHAS)])
    return ImagesClip(
        name=name or Path(folder).resolve().name,
        source=str(folder),
        width=size[0],
        height=size[1],
        timestamps=selection.timestamps,
        source_fps=options.fps,
        begin=selection.begin,
        available=selection.available,
        notes=selection.notes + notes,
        has_masks=given is not None,
        paths=chosen,
        stored_size=(width, height),
        masks=given,
    )
