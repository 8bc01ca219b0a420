"""Folders of images of every kind."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.formats.images import list_images, open_images, read_input_image

OPTIONS = InputOptions()


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".bmp", ".webp", ".jpg", ".PNG"])
def test_suffixes(tmp_path, make_image, write_image_file, suffix):
    for i in range(3):
        write_image_file(tmp_path / f"{i}{suffix}", make_image(i))
    clip = open_images(tmp_path, OPTIONS)
    frames = list(clip.frames([0, 1, 2]))
    for i, frame in enumerate(frames):
        assert frame.dtype == np.uint8
        assert np.abs(frame.astype(int) - make_image(i)).mean() < 3


def test_gray_alpha_and_16_bits(tmp_path, make_image, write_image_file):
    rgb = make_image(0)
    alpha = write_image_file(tmp_path / "alpha.png", np.dstack([rgb, np.zeros(rgb.shape[:2], np.uint8)]))
    np.testing.assert_array_equal(read_input_image(alpha), rgb)
    gray = write_image_file(tmp_path / "gray.png", rgb[..., 0])
    np.testing.assert_array_equal(read_input_image(gray), np.repeat(rgb[..., :1], 3, -1))
    deep = write_image_file(tmp_path / "deep.png", rgb.astype(np.uint16) * 257 + 100)
    np.testing.assert_array_equal(read_input_image(deep), rgb)
    deep_gray = write_image_file(tmp_path / "deep_gray.tiff", rgb[..., 0].astype(np.uint16) * 257)
    np.testing.assert_array_equal(read_input_image(deep_gray), np.repeat(rgb[..., :1], 3, -1))


def turn_by_exif(path: Path, orientation: int) -> Path:
    """Say in a JPEG how it has to be turned."""
    segment = b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">HHHIHHI", 1, 0x0112, 3, 1, orientation, 0, 0)
    data = path.read_bytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + data[2:])
    return path


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, -1), (8, 1)])
def test_exif_orientation(tmp_path, make_image, write_image_file, orientation, turns):
    path = turn_by_exif(write_image_file(tmp_path / "a.jpg", make_image(0)), orientation)
    got, upright = read_input_image(path), np.rot90(make_image(0), turns)
    assert got.shape == upright.shape
    assert np.abs(got.astype(int) - upright).mean() < 3


def test_natural_order_and_hidden_files(tmp_path, make_image, write_image_file):
    for name in ("frame10.png", "frame9.png", "frame1.png", ".frame0.png"):
        write_image_file(tmp_path / name, make_image(0))
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / "folder.png").mkdir()
    assert [path.name for path in list_images(tmp_path)] == ["frame1.png", "frame9.png", "frame10.png"]


def test_spaces_and_letters_of_the_world(tmp_path, make_image, write_image_file):
    folder = tmp_path / "Mein Video – 動画 é"
    for i in range(2):
        write_image_file(folder / f"Größe {i}.png", make_image(i))
    clip = open_images(folder, OPTIONS)
    assert clip.name == "Mein Video – 動画 é"
    np.testing.assert_array_equal(next(clip.frames([1])), make_image(1))


def test_times(tmp_path, make_image, write_image_file):
    for i in range(20):
        write_image_file(tmp_path / f"{i:03d}.png", make_image(i))
    clip = open_images(tmp_path, InputOptions(fps=10, start=0.5, every=3))
    np.testing.assert_allclose(clip.timestamps, np.arange(5) * 0.3)
    assert clip.source_fps == 10
    np.testing.assert_array_equal(next(clip.frames([2])), make_image(11))


def test_two_frames_work_and_one_does_not(tmp_path, make_image, write_image_file):
    write_image_file(tmp_path / "0.png", make_image(0))
    with pytest.raises(InputError, match="at least two frames"):
        open_images(tmp_path, OPTIONS)
    write_image_file(tmp_path / "1.png", make_image(1))
    assert open_images(tmp_path, OPTIONS).num_frames == 2


def test_resizing(tmp_path, make_image, write_image_file):
    for i in range(2):
        write_image_file(tmp_path / f"{i}.png", make_image(i, 1000, 500))
    sizes = {resize: open_images(tmp_path, InputOptions(resize=resize)) for resize in (None, 0, 100, 2000)}
    assert {resize: (clip.width, clip.height) for resize, clip in sizes.items()} == {
        None: (854, 427),
        0: (1000, 500),
        100: (100, 50),
        2000: (1000, 500),
    }
    assert ["--resize" in " ".join(clip.notes) for clip in sizes.values()] == [True, False, True, False]
    small = next(sizes[100].frames([0]))
    # The mean over areas: what averaging blocks of 10 x 10 pixels gives.
    np.testing.assert_allclose(small, make_image(0, 1000, 500).reshape(50, 10, 100, 10, 3).mean((1, 3)), atol=0.51)


# -- what cannot be used


def refuse(folder: Path, words: str, **options) -> None:
    with pytest.raises(InputError, match=words) as caught:
        list(read_all(folder, InputOptions(**options)))
    assert "\n" not in str(caught.value)


def read_all(folder: Path, options: InputOptions) -> Iterator[np.ndarray]:
    clip = open_images(folder, options)
    yield from clip.frames(range(clip.num_frames))


def test_no_images(tmp_path):
    (tmp_path / "readme.txt").write_text("empty")
    refuse(tmp_path, "no images")


def test_different_sizes(tmp_path, make_image, write_image_file):
    write_image_file(tmp_path / "first.png", make_image(0))
    write_image_file(tmp_path / "second.png", make_image(0, 64, 50))
    refuse(tmp_path, r"second\.png is 64x50 pixels, but .*first\.png is 64x48")


@pytest.mark.parametrize("data", [b"", b"no image", None])
def test_damaged(tmp_path, make_image, write_image_file, data):
    write_image_file(tmp_path / "0.png", make_image(0))
    path = write_image_file(tmp_path / "1.png", make_image(1))
    path.write_bytes(path.read_bytes()[:40] if data is None else data)
    refuse(tmp_path, r"1\.png is missing, empty, damaged")


def test_floating_point(tmp_path, make_image, write_image_file):
    for i in range(2):
        write_image_file(tmp_path / f"{i}.tiff", make_image(i).astype(np.float32))
    refuse(tmp_path, "8 or 16 bits")


def test_same_name_twice(tmp_path, make_image, write_image_file):
    write_image_file(tmp_path / "0.png", make_image(0))
    write_image_file(tmp_path / "0.jpg", make_image(0))
    refuse(tmp_path, "same name")


def test_too_small(tmp_path, make_image, write_image_file):
    for i in range(2):
        write_image_file(tmp_path / f"{i}.png", make_image(i, 400, 20))
    refuse(tmp_path, "too small")


@pytest.mark.parametrize(("alpha", "is_said"), [(0, True), (255, False), (None, False)])
def test_alpha_that_is_left_out_is_said(tmp_path, make_image, write_image_file, alpha, is_said: bool):
    for i in range(5):
        image = make_image(i)
        if alpha is not None:
            image = np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])
            image[:9, :9, 3] = alpha
        write_image_file(tmp_path / f"{i}.png", image)
    notes = [note for note in open_images(tmp_path, OPTIONS).notes if "alpha" in note]
    assert len(notes) == is_said
    assert all("--given.masks" in note for note in notes)
