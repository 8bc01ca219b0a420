"""The size of an image is known, and believed, before it is decoded."""

from __future__ import annotations

import tracemalloc
import zlib

import cv2
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.images.header import can_hold, image_pixels
from flowsplat.scenes.layers import decode_image, read_image, write_image

KINDS = (".png", ".jpg", ".webp", ".tiff", ".bmp")


def chunk(name: bytes, data: bytes) -> bytes:
    return len(data).to_bytes(4, "big") + name + data + zlib.crc32(name + data).to_bytes(4, "big")


def png(width: int, height: int, pixels: bytes) -> bytes:
    """A gray image that says it has that size."""
    head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")


@pytest.mark.parametrize("suffix", KINDS)
@pytest.mark.parametrize("size", [(64, 48), (1, 1), (300, 2), (4000, 3000)])
def test_sizes_are_read_and_images_of_one_color_are_held(suffix, size):
    ok, data = cv2.imencode(suffix, np.full((size[1], size[0], 3), 255, np.uint8))
    assert ok
    assert image_pixels(data.tobytes()) == size
    assert can_hold(data.tobytes(), size), "the smallest that an image can be packed"


def test_more_than_the_bytes_can_hold_is_no_image(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(png(7000, 7000, b"\0" * 100))
    tracemalloc.start()
    try:
        assert decode_image(path, cv2.IMREAD_UNCHANGED) is None
        assert tracemalloc.get_traced_memory()[1] < 2**20, "NumPy's arrays count"
    finally:
        tracemalloc.stop()
    path.write_bytes(png(7, 2, b"\0" * 16))
    assert read_image(path).shape == (2, 7)


def test_another_size_than_expected_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    write_image(tmp_path / "a.png", np.zeros((48, 64, 3), np.uint8))
    assert read_image(tmp_path / "a.png", (64, 48)).shape == (48, 64, 3)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(InputError, match="has 64 x 48 pixels, expected 48 x 64"):
        read_image(tmp_path / "a.png", (48, 64))


def test_more_pixels_than_are_read_are_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(png(60_000, 60_000, b""))
    with pytest.raises(InputError, match="more than the 55 million"):
        decode_image(tmp_path / "a.png", cv2.IMREAD_UNCHANGED)
