"""Depth out of an OpenEXR image: one channel of half or float, as OpenEXR's own library packs it unless it is told otherwise.

https://openexr.com/en/latest/OpenEXRFileLayout.html: a header of named attributes, the places of the blocks, and blocks of one row
(not packed, or ZIPS) or of 16 (ZIP).
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np

from flowsplat.scenes.layers import MAX_PIXELS

_BOM = b"\x76\x2f\x31\x01"
_ROWS = {0: 1, 2: 1, 3: 16}
"""Rows of a block, by the number of how it is packed: not at all, ZIPS, ZIP."""
_TYPES: dict[int, np.dtype[Any]] = {1: np.dtype("<f2"), 2: np.dtype("<f4")}
"""Values of a channel, by the number of their type."""


def decode_exr(data: bytes) -> np.ndarray:
    """Return [H, W] float16 or float32.

    Raises:
        ValueError, struct.error, zlib.error: damaged, or none that is understood here.
    """
    if data[:4] != _BOM or data[4] != 2 or any(data[5:8]):
        raise ValueError("it is no OpenEXR image of plain rows")
    attributes, at = _read_header(data)
    packing, (left, top, right, bottom) = attributes["compression"][0], struct.unpack("<4i", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    channels = attributes["channels"]
    end = channels.index(b"\0")
    kind, step_x, step_y = *struct.unpack_from("<i", channels, end + 1), *struct.unpack_from("<2i", channels, end + 9)
    if len(channels) != end + 18 or kind not in _TYPES or (step_x, step_y) != (1, 1):
        raise ValueError("it is not one channel of half or float")
    if packing not in _ROWS:
        raise ValueError("it is packed in another way than ZIP")
    if min(width, height) < 1 or width * height > MAX_PIXELS:
        raise ValueError(f"it has {width:,} x {height:,} pixels")
    values = np.zeros((height, width), _TYPES[kind])
    rows = _ROWS[packing]
    for place in struct.unpack_from(f"<{-(-height // rows)}Q", data, at):
        row, size = struct.unpack_from("<2i", data, place)
        row -= top
        if row % rows or not 0 <= row < height:
            raise ValueError("a block is of no row")
        block = values[row : row + rows]
        values[row : row + rows] = _unpack(data[place + 8 : place + 8 + size], block.nbytes).view(values.dtype).reshape(block.shape)
    return values


def _read_header(data: bytes) -> tuple[dict[str, bytes], int]:
    """Return the attributes by their names, and where the header ends."""
    attributes, at = {}, 8
    while data[at] != 0:
        name_end = data.index(b"\0", at)
        kind_end = data.index(b"\0", name_end + 1)
        (size,) = struct.unpack_from("<I", data, kind_end + 1)
        start = kind_end + 5
        attributes[data[at:name_end].decode()] = data[start : start + size]
        at = start + size
    missing = {"compression", "dataWindow", "channels"} - attributes.keys()
    if missing:
        raise ValueError(f"it has no {min(missing)}")
    return attributes, at + 1


def _unpack(packed: bytes, length: int) -> np.ndarray:
    """Return the bytes of a block [length]; one that packing would not have made smaller lies there as it is."""
    if len(packed) == length:
        return np.frombuffer(packed, np.uint8).copy()
    unpacker = zlib.decompressobj()
    stored = np.frombuffer(unpacker.decompress(packed, length + 1), np.uint8)
    if len(stored) != length:
        raise ValueError("a block is not as long as its rows")
    # Differences, of the bytes at even places and then of those at odd ones.
    stored = np.cumsum(stored.astype(np.int64) - np.where(np.arange(length) > 0, 128, 0)).astype(np.uint8)
    values = np.empty(length, np.uint8)
    values[::2], values[1::2] = stored[: -(-length // 2)], stored[-(-length // 2) :]
    return values
