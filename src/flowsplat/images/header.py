"""Read how large an image says it is, before it is decoded: some kilobytes can ask for gigabytes."""

from __future__ import annotations

import struct

MAX_PIXELS = 55_000_000
"""Of one image; at 16 bits a channel they take 315 MiB. Chosen by eye."""

_START_OF_FRAME = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_STANDALONE = {0x01, *range(0xD0, 0xD9)}


def image_pixels(data: bytes) -> tuple[int, int] | None:
    """Return (width, height) that a PNG, JPEG, WebP, TIFF or BMP names; None where it is none of these, or is cut off."""
    readers = (
        (b"\x89PNG\r\n\x1a\n", _png), (b"\xff\xd8", _jpeg), (b"RIFF", _webp), (b"II*\0", _tiff), (b"MM\0*", _tiff), (b"BM", _bmp),
    )  # fmt: skip
    for start, read in readers:
        if data[: len(start)] == start:
            try:
                return read(data)
            except (struct.error, IndexError, ValueError):
                return None
    return None


def can_hold(data: bytes, size: tuple[int, int]) -> bool:
    """Return whether the pixels of a PNG or JPEG may be in its bytes, however well they were compressed; others are not looked at.

    A header that was damaged asks for memory that nothing will ever fill.
    """
    width, height = size
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) > 25:
        bits = data[24] * {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(data[25], 1)
        return height * (1 + width * bits // 8) <= 1100 * len(data)  # deflate makes 1032 bytes of one
    if data[:2] == b"\xff\xd8":
        return width * height <= 1000 * len(data)  # a block of 64 pixels takes a bit at least
    return True


def _png(data: bytes) -> tuple[int, int]:
    if data[12:16] != b"IHDR":
        raise ValueError("no header")
    at = 8
    while data[at + 4 : at + 8] != b"IEND":  # OpenCV makes room for as much as a part says it has
        at += 12 + int(struct.unpack_from(">I", data, at)[0])
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _jpeg(data: bytes) -> tuple[int, int]:
    at = 2
    while True:
        if data[at] != 0xFF:
            raise ValueError("no marker")
        while data[at] == 0xFF:  # any number of them may fill
            at += 1
        marker, at = data[at], at + 1
        if marker in _STANDALONE:
            continue
        if marker in _START_OF_FRAME:
            height, width = struct.unpack_from(">HH", data, at + 3)
            return width, height
        at += max(struct.unpack_from(">H", data, at)[0], 2)


def _webp(data: bytes) -> tuple[int, int]:
    if data[8:12] != b"WEBP":
        raise ValueError("another RIFF")
    kind = data[12:16]
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
        _ = data[29]
        return width, height
    if kind == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    raise ValueError("no image")


def _tiff(data: bytes) -> tuple[int, int]:
    order = "<" if data[:1] == b"I" else ">"
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    found: dict[int, int] = {}
    for k in range(count):
        tag, kind = struct.unpack_from(order + "HH", data, at + 2 + 12 * k)
        if tag in (256, 257) and kind in (3, 4):
            (found[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, at + 10 + 12 * k)
    if len(found) < 2:
        raise ValueError("no size")
    return found[256], found[257]


def _bmp(data: bytes) -> tuple[int, int]:
    if struct.unpack_from("<I", data, 14)[0] == 12:  # of OS/2
        width, height = struct.unpack_from("<HH", data, 18)
    else:
        width, height = struct.unpack_from("<ii", data, 18)
    return abs(width), abs(height)
