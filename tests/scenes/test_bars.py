"""Black bars are cut off before anything is measured; what is only dark is kept."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.scenes.bars import find_content, find_sharp_content
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.ingest import ingest, open_clip

from .conftest import write_image_file, write_video

SIZE = (96, 64)
"""Width and height of what is shown."""


def textured(i: int, dim: float = 1.0) -> np.ndarray:
    """A texture that moves, RGB [64, 96, 3] uint8."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 2 * i, np.arange(SIZE[1]))
    return np.rint(dim * (120 + 60 * np.sin(x / 5)[..., None] + 40 * np.cos(y / 4)[..., None] + [20, 0, -20])).astype(np.uint8)


def with_bars(image: np.ndarray, top: int = 0, left: int = 0, level: int = 0) -> np.ndarray:
    return np.pad(image, ((top, top), (left, left), (0, 0)), constant_values=level)


BARS = [(12, 0), (0, 20), (12, 20)]


@pytest.mark.parametrize(("top", "left"), BARS)
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".mp4"])
def test_bars_are_cut_and_said(tmp_path: Path, top: int, left: int, suffix: str):
    images = [with_bars(textured(i), top, left) for i in range(5)]
    path = tmp_path / f"clip{suffix}"
    if suffix == ".mp4":
        write_video(path, images)
    else:
        for i, image in enumerate(images):
            write_image_file(path / f"{i}{suffix}", image)
    clip = open_clip(path, InputOptions())
    assert (clip.width, clip.height) == SIZE
    said = [note for note in clip.notes if "black bars" in note]
    assert said == [f"Cut off black bars: 96x64 of {96 + 2 * left}x{64 + 2 * top} pixels are left (--crop off keeps all)."]
    for i, image in enumerate(clip.frames(range(5))):
        assert np.abs(image.astype(int) - textured(i)).mean() < 6
    kept = open_clip(path, InputOptions(crop="off"))
    assert (kept.width, kept.height) == (96 + 2 * left, 64 + 2 * top)


def test_masks_are_cut_like_their_images_and_the_size_is_of_what_is_left(tmp_path: Path):
    for i in range(4):
        image = with_bars(textured(i), left=16)
        write_image_file(tmp_path / "images" / f"{i}.png", image)
        mask = np.zeros(image.shape[:2], np.uint8)
        mask[10:30, 16 + 8 : 16 + 40] = 255
        write_image_file(tmp_path / "masks" / f"{i}.png", mask)
    options = InputOptions(holdout=3, resize=72)
    scene = ingest(open_clip(tmp_path, options), tmp_path / "scene", options)
    assert (scene.width, scene.height) == (72, 48)
    rows, columns = np.nonzero(scene.mask(0))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == pytest.approx((7.5, 22, 6, 29.5), abs=0.6)
    assert any("Resized from 96x64 to 72x48" in note for note in scene.info.notes)


def night(i: int) -> np.ndarray:
    """A black sky over lit roofs of several heights, and black ground."""
    image = np.zeros((120, 160, 3), np.uint8)
    for k in range(8):
        image[30 + 9 * (k % 4) : 90, 20 * k : 20 * k + 20] = 60 + 20 * k + i
    return image


def roof(i: int) -> np.ndarray:
    """A lit roof, straight and level, that moves down by a row a frame."""
    image = np.zeros((120, 160, 3), np.uint8)
    image[40 + i : 80 + i] = 120
    return image


def dark(i: int) -> np.ndarray:
    """A shadow that ends at a row, before what is hardly brighter."""
    image = np.full((120, 160, 3), 4, np.uint8)
    image[30:90] = 16
    return image


def moon(i: int) -> np.ndarray:
    """Something small in the dark."""
    image = np.zeros((120, 160, 3), np.uint8)
    image[50:70, 60 + i : 80 + i] = 220
    return image


def one_side(i: int) -> np.ndarray:
    return with_bars(textured(i), 12)[12:]


def bright(i: int) -> np.ndarray:
    return with_bars(textured(i), 12, level=250)


def subtitle(i: int) -> np.ndarray:
    """Letters in a bar at some time are shown."""
    image = with_bars(textured(i), 20)
    image[-8:-2, 30:60] = 200 * (i == 3)
    image[2:8, 30:60] = 200 * (i == 2)
    return image


@pytest.mark.parametrize("scene", [night, roof, dark, moon, one_side, bright, subtitle, textured])
def test_what_is_no_bar_is_kept(scene):
    assert find_content(scene(i) for i in range(24)) is None


def test_a_fade_from_black_hides_no_bars_and_makes_none():
    assert find_content(with_bars(textured(i, i / 5), 12) for i in range(6)) == (0, 12, 96, 76)
    assert find_content(textured(i, i / 5) for i in range(6)) is None


def test_what_has_no_bars_is_hardly_read():
    seen = []

    def images():
        for i in range(24):
            seen.append(i)
            yield textured(i)

    assert find_content(images()) is None
    assert len(seen) == 1


def test_too_little_between_bars_is_refused_in_one_line(tmp_path: Path):
    for i in range(3):
        write_image_file(tmp_path / f"{i}.png", with_bars(textured(i)[:20], 40))
    with pytest.raises(InputError, match="96x20 pixels are too small") as error:
        open_clip(tmp_path, InputOptions())
    assert "\n" not in str(error.value)


def wall(i: int, size: tuple[int, int]) -> np.ndarray:
    """Blotches of all sizes that move, RGB [H, W, 3] uint8."""
    noise = np.random.default_rng(0).normal(0, 1, (size[1], size[0] + 60, 3)).astype(np.float32)
    sum_of = sum(sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (1.0, 4.0, 12.0))
    return np.clip(120 + 60 * sum_of[:, 3 * i : 3 * i + size[0]], 0, 255).astype(np.uint8)


def with_blurred_bars(middle: np.ndarray, size: tuple[int, int], dim: float = 1.0, sigma: float = 6.0) -> np.ndarray:
    """The middle of an image before an enlarged, blurred copy of it."""
    height, width = middle.shape[:2]
    scale = max(size[0] / width, size[1] / height)
    large = cv2.resize(middle, (round(scale * width), round(scale * height)))
    top, left = (large.shape[0] - size[1]) // 2, (large.shape[1] - size[0]) // 2
    image = cv2.GaussianBlur(large[top : top + size[1], left : left + size[0]], (0, 0), sigma)
    image = np.rint(dim * image).astype(np.uint8)
    top, left = (size[1] - height) // 2, (size[0] - width) // 2
    image[top : top + height, left : left + width] = middle
    return image


@pytest.mark.parametrize(
    ("middle", "whole", "dim", "still"),
    [((90, 120), (212, 120), 1.0, False), ((120, 68), (120, 212), 0.6, False), ((90, 120), (212, 120), 0.8, True)],
)
def test_blurred_bars_are_cut_and_said(tmp_path: Path, middle: tuple[int, int], whole: tuple[int, int], dim: float, still: bool):
    shown = [wall(0 if still else i, middle) for i in range(6)]
    if still:  # or all would be repeats
        shown = [cv2.circle(image.copy(), (10 + 10 * i, 60), 6, (255, 255, 255), -1) for i, image in enumerate(shown)]
    path = write_video(tmp_path / "clip.mp4", [with_blurred_bars(image, whole, dim) for image in shown])
    clip = open_clip(path, InputOptions())
    assert (clip.width, clip.height) == middle
    said = [note for note in clip.notes if "bars" in note]
    size, of = f"{middle[0]}x{middle[1]}", f"{whole[0]}x{whole[1]}"
    assert said == [f"Cut off blurred bars: {size} of {of} pixels are left (--crop off keeps all)."]
    for image, expected in zip(clip.frames(range(clip.num_frames)), shown, strict=True):
        assert np.abs(image.mean(-1) - expected.mean(-1)).mean() < 6  # chroma is stored at half the size
    kept = open_clip(path, InputOptions(crop="off"))
    assert (kept.width, kept.height) == whole


def out_of_focus(i: int) -> np.ndarray:
    """Sides that are blurred more and more."""
    image, blurred = wall(i, (212, 120)), cv2.GaussianBlur(wall(i, (212, 120)), (0, 0), 8)
    weight = np.clip((np.abs(np.arange(212) - 106) - 45) / 20, 0, 1)[:, None]
    return np.rint((1 - weight) * image + weight * blurred).astype(np.uint8)


def doorway(i: int) -> np.ndarray:
    """A camera that stands still before a door between two even walls."""
    image = cv2.GaussianBlur(wall(0, (212, 120)), (0, 0), 12)
    image[:, 61:151] = wall(i, (90, 120))
    return image


def one_blurred_side(i: int) -> np.ndarray:
    image = with_blurred_bars(wall(i, (90, 120)), (212, 120))
    image[:, 151:] = wall(i, (61, 120))
    return image


def narrow(i: int) -> np.ndarray:
    """An object in focus before what is not, which moves."""
    image = cv2.GaussianBlur(wall(i, (212, 120)), (0, 0), 8)
    image[:, 61 + 3 * i : 151 + 3 * i] = wall(0, (90, 120))
    return image


@pytest.mark.parametrize("scene", [out_of_focus, doorway, one_blurred_side, narrow, lambda i: wall(i, (212, 120)), textured, roof])
def test_what_is_blurred_and_no_bar_is_kept(scene):
    assert find_sharp_content(scene(i) for i in range(12)) is None


def test_what_has_no_blurred_bars_is_hardly_read():
    seen = []

    def images():
        for i in range(24):
            seen.append(i)
            yield wall(i, (212, 120))

    assert find_sharp_content(images()) is None
    assert len(seen) == 1


def test_blurred_bars_of_clips(data: Path):
    for folder, size in (("bars", (76, 134)), ("bars_lucia", (76, 136))):
        clip = open_clip(data / "given" / folder / "blurpillar.mp4", InputOptions())
        assert (clip.width, clip.height) == size
