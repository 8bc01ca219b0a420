"""Masks of every kind become numbers of objects."""

from __future__ import annotations

import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.formats.davis import open_davis
from flowsplat.scenes.formats.images import ImagesClip, open_images
from tests.scenes.conftest import make_image, write_image_file

from .test_images import turn_by_exif

SHAPE = (48, 64)
DAVIS_PALETTE = [(0, 0, 0), (128, 0, 0), (0, 128, 0), (128, 128, 0), (0, 0, 128)]


def write_palette(path: Path, indices: np.ndarray, palette: list[tuple[int, int, int]]) -> None:
    """A palette PNG, as DAVIS has them (OpenCV only writes colors)."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = indices.shape
    rows = b"".join(b"\0" + row.tobytes() for row in indices.astype(np.uint8))
    header = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    colors = bytes(value for color in palette for value in color)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"PLTE", colors)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def blocks(*values: int) -> np.ndarray:
    """Vertical stripes of the given values, after one of background."""
    labels = np.zeros(SHAPE, np.uint8)
    for k, value in enumerate(values):
        labels[:, 10 * (k + 1) : 10 * (k + 2)] = value
    return labels


@pytest.fixture
def folder(tmp_path, make_image, write_image_file) -> Path:
    for i in range(3):
        write_image_file(tmp_path / "images" / f"{i:05d}.png", make_image(i))
    return tmp_path


def open_with_masks(folder: Path, **options) -> ImagesClip:
    return open_images(folder / "images", InputOptions(**options), folder / "masks")


@pytest.mark.parametrize("kind", ["gray", "gray and alpha", "color", "half"])
def test_black_and_white(folder, write_image_file, kind):
    mask = blocks(255)
    image = {
        "gray": mask,
        "gray and alpha": np.dstack([mask, mask, mask, np.full(SHAPE, 255, np.uint8)]),
        "color": np.dstack([mask] * 3),
        "half": mask // 2,
    }[kind]
    for i in range(3):
        write_image_file(folder / "masks" / f"{i:05d}.png", image)
    clip = open_with_masks(folder)
    assert clip.has_masks
    np.testing.assert_array_equal(clip.mask(1), mask > 0)


def test_alpha_is_no_object(folder, write_image_file):
    for i in range(3):
        write_image_file(
            folder / "masks" / f"{i:05d}.png", np.dstack([np.zeros((*SHAPE, 3), np.uint8), np.full(SHAPE, 255, np.uint8)])
        )
    assert not open_with_masks(folder).mask(0).any()


def test_numbers_are_the_same_in_all_frames(folder, write_image_file):
    for i, values in enumerate([(1, 4, 9), (9,), (4,)]):
        write_image_file(folder / "masks" / f"{i:05d}.png", blocks(*values))
    clip = open_with_masks(folder)
    np.testing.assert_array_equal(clip.mask(0), blocks(1, 2, 3))
    np.testing.assert_array_equal(clip.mask(1), blocks(3))
    np.testing.assert_array_equal(clip.mask(2), blocks(2))


def test_palette(folder):
    """The objects of DAVIS keep their numbers."""
    for i, values in enumerate([(1, 2, 3, 4), (4, 2), (3,)]):
        write_palette(folder / "masks" / f"{i:05d}.png", blocks(*values), DAVIS_PALETTE)
    clip = open_with_masks(folder)
    for i, values in enumerate([(1, 2, 3, 4), (4, 2), (3,)]):
        np.testing.assert_array_equal(clip.mask(i), blocks(*values))


def test_a_color_is_the_same_object_whatever_else_is_seen(folder, write_image_file):
    """White is no shade of red where the red object has left."""
    for i, colors in enumerate([((255, 0, 0), (255, 255, 255)), ((255, 255, 255),), ((255, 0, 0),)]):
        image = np.zeros((*SHAPE, 3), np.uint8)
        for k, color in enumerate(colors):
            image[:, 10 * (k + 1) : 10 * (k + 2)] = color
        write_image_file(folder / "masks" / f"{i:05d}.png", image)
    clip = open_with_masks(folder)
    np.testing.assert_array_equal(clip.mask(0), blocks(1, 2))
    np.testing.assert_array_equal(clip.mask(1), blocks(2))
    np.testing.assert_array_equal(clip.mask(2), blocks(1))


def test_soft_edges_are_one_object(folder, write_image_file):
    soft = np.tile(np.arange(64, dtype=np.uint8) * 4, (48, 1))
    for i in range(3):
        write_image_file(folder / "masks" / f"{i:05d}.png", soft)
    np.testing.assert_array_equal(open_with_masks(folder).mask(0), soft > 0)


def test_jpeg_noise_is_background(folder, write_image_file):
    for i in range(3):
        write_image_file(folder / "masks" / f"{i:05d}.jpg", blocks(255))
    np.testing.assert_array_equal(open_with_masks(folder).mask(0), blocks(1))


@pytest.mark.parametrize("value", [0, 255])
def test_empty_and_full(folder, write_image_file, value):
    for i in range(3):
        write_image_file(folder / "masks" / f"{i:05d}.png", np.full(SHAPE, value, np.uint8))
    assert (open_with_masks(folder).mask(2) == (value > 0)).all()


def test_resized_with_their_images(tmp_path, make_image, write_image_file):
    labels = np.zeros((96, 128), np.uint8)
    labels[:, 64:] = 2
    labels[48:, 64:] = 7
    for i in range(2):
        write_image_file(tmp_path / "images" / f"{i}.png", make_image(i, 128, 96))
        write_image_file(tmp_path / "masks" / f"{i}.png", labels)
    mask = open_with_masks(tmp_path, resize=64).mask(0)
    assert mask.shape == (48, 64)
    assert set(np.unique(mask)) == {0, 1, 2}
    assert (mask > 0).mean() == 0.5


# -- what cannot be used


def refuse(folder: Path, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        open_with_masks(folder)
    assert "\n" not in str(caught.value)


def test_missing(folder, write_image_file):
    for i in (0, 2):
        write_image_file(folder / "masks" / f"{i:05d}.png", blocks(255))
    refuse(folder, r"no mask for 00001\.png")


def test_extra(folder, write_image_file):
    for i in range(4):
        write_image_file(folder / "masks" / f"{i:05d}.png", blocks(255))
    refuse(folder, r"00003\.png belongs to no image")


def test_wrong_size(folder, write_image_file):
    for i in range(3):
        write_image_file(folder / "masks" / f"{i:05d}.png", blocks(255)[: 48 - 8 * (i == 2)])
    refuse(folder, r"00002\.png is 64x40 pixels, but its image is 64x48")


def test_damaged(folder, write_image_file):
    for i in range(3):
        write_image_file(folder / "masks" / f"{i:05d}.png", blocks(255))
    (folder / "masks" / "00001.png").write_bytes(b"no image")
    refuse(folder, r"00001\.png is no readable mask")


# -- the DAVIS data set


@pytest.fixture
def davis(folder) -> Path:
    root = folder / "DAVIS"
    for name in ("bear", "dog10", "dog9"):
        shutil.copytree(folder / "images", root / "JPEGImages" / "480p" / name)
    for i in range(3):
        write_palette(root / "Annotations" / "480p" / "bear" / f"{i:05d}.png", blocks(1, 2), DAVIS_PALETTE)
    return root


def test_davis(davis):
    clip = open_davis(davis, InputOptions(sequence="bear"))
    assert (clip.name, clip.num_frames, clip.source_fps) == ("bear", 3, 24)
    np.testing.assert_array_equal(clip.mask(1), blocks(1, 2))


def test_davis_without_masks(davis):
    """Of test sequences only the first mask is published, if any."""
    assert not open_davis(davis, InputOptions(sequence="dog9")).has_masks
    write_palette(davis / "Annotations" / "480p" / "dog9" / "00000.png", blocks(1), DAVIS_PALETTE)
    assert not open_davis(davis, InputOptions(sequence="dog9")).has_masks


@pytest.mark.parametrize("sequence", [None, "cat", "..", ""])
def test_davis_without_such_a_sequence(davis, sequence):
    with pytest.raises(InputError, match=r"bear, dog9, dog10 with --sequence"):
        open_davis(davis, InputOptions(sequence=sequence))


def test_no_davis(tmp_path):
    with pytest.raises(InputError, match="JPEGImages"):
        open_davis(tmp_path, InputOptions(sequence="bear"))


def test_colors_of_16_bits_are_as_many_objects(folder, write_image_file):
    colors = np.array([[0, 0, 0], [65535, 0, 0], [0, 0, 65535]], np.uint16)[blocks(1, 2)]
    for i in range(3):
        write_image_file(folder / "masks" / f"{i:05d}.png", colors)
    clip = open_with_masks(folder)
    assert np.unique(clip.mask(0)).tolist() == [0, 1, 2]


def write_turned(folder: Path, orientation: int, mask: np.ndarray, suffix: str, mask_orientation: int | None = None) -> ImagesClip:
    """Three JPEGs that EXIF turns, each with that mask."""
    for i in range(3):
        turn_by_exif(write_image_file(folder / "images" / f"{i}.jpg", make_image(i)), orientation)
        path = write_image_file(folder / "masks" / f"{i}{suffix}", mask)
        if mask_orientation is not None:
            turn_by_exif(path, mask_orientation)
    return open_with_masks(folder)


@pytest.mark.parametrize(("orientation", "quarters"), [(6, -1), (8, 1)])
@pytest.mark.parametrize("mask_is", ["stored as its image", "upright", "turned by EXIF"])
def test_masks_lie_on_images_that_exif_turns(tmp_path: Path, orientation: int, quarters: int, mask_is: str):
    stored = np.zeros(SHAPE, np.uint8)
    stored[4:16, 8:56] = 255
    upright = np.rot90(stored, quarters)
    if mask_is == "turned by EXIF":
        clip = write_turned(tmp_path, orientation, stored, ".jpg", orientation)
    else:
        clip = write_turned(tmp_path, orientation, upright if mask_is == "upright" else stored, ".png")
    assert (clip.width, clip.height) == SHAPE
    for i in range(3):
        np.testing.assert_array_equal(clip.mask(i), upright > 0)
    assert any("Masks were turned" in note for note in clip.notes) == (mask_is == "stored as its image")
    assert not any("taken as they are" in note for note in clip.notes)


@pytest.mark.parametrize("has_tag", [False, True])
def test_half_a_turn_is_not_told_by_sizes(tmp_path: Path, has_tag: bool):
    stored = np.zeros(SHAPE, np.uint8)
    stored[4:16, 8:40] = 255
    clip = write_turned(tmp_path, 3, stored, ".jpg" if has_tag else ".png", 3 if has_tag else None)
    np.testing.assert_array_equal(clip.mask(1), np.rot90(stored, 2) > 0 if has_tag else stored > 0)
    assert any("taken as they are" in note for note in clip.notes) == (not has_tag)


def test_a_mask_of_another_size_is_refused_beside_turned_images(tmp_path: Path):
    with pytest.raises(InputError, match="masks must have the size of their images"):
        write_turned(tmp_path, 6, np.zeros((40, 64), np.uint8), ".png")
    shutil.rmtree(tmp_path)
    with pytest.raises(InputError, match="masks must have the size of their images"):
        write_turned(tmp_path, 1, np.zeros(SHAPE[::-1], np.uint8), ".png")
