"""The bytes of a ``.4dgs`` file, version 1 (draft) of the format of Avala AI: https://github.com/avala-ai/4dgs, Apache-2.0.

After the magic come records, each an opcode (u8), the length of its content (u64) and the content; at the end the magic again.
Numbers are little-endian. Gaussians lie in chunks, each for an interval of time, one stream of integers for every attribute: what
an integer stands for follows from the steps in one record, which is read before them.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

MAGIC = b"\x894DGS1\r\n"
HEADER, FOOTER, QUANTIZATION, WINDOW_TABLE, CHUNK, SH_BAND, CHUNK_INDEX = 0x01, 0x02, 0x03, 0x04, 0x05, 0x07, 0x08
CAMERA, STATISTICS, AUDIO_SOURCE, AUDIO_DATA = 0x0A, 0x0C, 0x11, 0x12
COORDINATE_FRAME, SENSOR, TRAJECTORY, OBJECT_TABLE = 0x20, 0x21, 0x22, 0x24
POSITION, SCALE, ROTATION_INDEX, ROTATION, COLOR, OPACITY, MOTION, CENTER_TIME, DEVIATION, FLAGS, WINDOW = range(11)
"""Attributes by their numbers; there is one stream of each in every chunk."""
OBJECT_ID = 14
RIGHT_HANDED, Y_UP, Z_BACKWARD = 1, 1, 5
_RAW, _DELTA, _CONSTANT, _DEFLATE = 0, 1, 2, 0
_PINHOLE, _ON_RIG, _LINEAR = 1, 1, 0
_LEVEL = 6
"""Of deflate: 9 takes twice as long for 2 % (a scene of 77,239 Gaussians)."""
MAX_BIN = 2**30 - 1
"""Of an integer of a stream: the difference of two, without its sign, has 32 bits."""


def record(opcode: int, content: bytes) -> bytes:
    """Return a record."""
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(text: str) -> bytes:
    raw = text.encode("utf-8")
    return struct.pack("<I", len(raw)) + raw


def _texts(texts: Mapping[str, str]) -> bytes:
    body = b"".join(_text(key) + _text(value) for key, value in sorted(texts.items()))
    return struct.pack("<I", len(body)) + body


def _doubles(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


@dataclass(frozen=True)
class Steps:
    """What one more is in the integers of the file; scales and deviations in time are stored as logarithms.

    Attributes:
        position: in units of the file.
        scale: of a logarithm.
        rotation: of a component of a quaternion.
        color: of 1.
        opacity: of 1.
        motion: units a second, of a Gaussian of half a second.
        time: seconds.
        deviation: of a logarithm.
    """

    position: float
    scale: float
    rotation: float
    color: float
    opacity: float
    motion: float
    time: float
    deviation: float


def header(
    library: str, duration: float, count: int, cutoff: float, low: np.ndarray, high: np.ndarray, degree: int, has_sound: bool,
    attributes: Mapping[str, str],
) -> bytes:  # fmt: skip
    """Return the first record.

    Args:
        library: who wrote it.
        duration: seconds.
        count: Gaussians in all chunks.
        cutoff: presence from which on one is there.
        low: [3] the least of each coordinate.
        high: [3] the greatest.
        degree: of the harmonics.
        has_sound: whether there are records of it.
        attributes: what else there is to say, by the names of the format.
    """
    return record(
        HEADER,
        _text("") + _text(library) + struct.pack("<dQd", duration, count, cutoff) + _text("gaussian-birth")
        + _doubles(*low, *high) + struct.pack("<BB", degree, int(has_sound)) + _texts(attributes),
    )  # fmt: skip


def quantization(origin: np.ndarray, steps: Steps) -> bytes:
    """Return what the integers stand for, and the errors that rounding to them makes.

    Args:
        origin: [3] of positions.
        steps: what one more is.
    """
    sizes = (
        steps.position, steps.scale, steps.rotation, steps.color, steps.opacity, steps.motion, steps.time, steps.deviation
    )  # fmt: skip
    names = ("pos", "scale_rel", "rot", "rgb", "alpha", "motion", "time", "sigma_rel")
    bounds = {name: size / 2 for name, size in zip(names, sizes, strict=True)}
    for name in ("scale_rel", "sigma_rel"):
        bounds[name] = float(np.expm1(bounds[name]))
    texts = {name: f"{value:.9g}" for name, value in bounds.items()} | {"sh": "0"}
    return record(
        QUANTIZATION, _text("uniform-v1") + _doubles(*origin) + _doubles(*sizes) + struct.pack("<B", 1) + _texts(texts)
    )  # fmt: skip


def window_table(windows: np.ndarray) -> bytes:
    """Return the times [W, 2] from and until which Gaussians are there, in seconds."""
    return record(WINDOW_TABLE, struct.pack("<I", len(windows)) + np.ascontiguousarray(windows, "<f8").tobytes())


def sound(data: bytes, layout: str, seconds: float) -> bytes:
    """Return the two records of one sound from everywhere, from the beginning on.

    Args:
        data: Opus in Ogg.
        layout: of its channels, "mono" or "stereo".
        seconds: how long it is.
    """
    number = struct.pack("<I", 0)
    pose = _doubles(0, 0, 0) + _doubles(0, 0, 0, 1)
    about = (
        number + _text("") + _text("opus") + _text(layout) + struct.pack("<QdddB", len(data), 0.0, seconds, 1.0, 0) + pose
        + struct.pack("<I", 0) + _text("linear")
    )  # fmt: skip
    return record(AUDIO_SOURCE, about) + record(AUDIO_DATA, number + struct.pack("<Q", len(data)) + data)


def coordinate_frame() -> bytes:
    """Return that y is up and z backward, in a unit that nobody knows."""
    return record(COORDINATE_FRAME, _text("") + struct.pack("<BBBBd", RIGHT_HANDED, Y_UP, Z_BACKWARD, 0, 0.0))


def rig(times: np.ndarray, quats: np.ndarray, places: np.ndarray, intrinsics: Sequence[float], size: tuple[int, int]) -> bytes:
    """Return the records of a camera and its way.

    Args:
        times: [T] seconds.
        quats: [T, 4] xyzw from the axes of the camera (x right, y down, z forward) to those of the file.
        places: [T, 3] of the camera.
        intrinsics: fx, fy, cx, cy in pixels.
        size: width and height of its images.
    """
    pose = _doubles(0, 0, 0, 1) + _doubles(0, 0, 0)
    sensor = (
        _text("camera") + _text("camera") + struct.pack("<BII", _PINHOLE, *size) + _doubles(*intrinsics) + struct.pack("<B", 0)
        + pose + struct.pack("<B", _ON_RIG) + _text("camera")
    )  # fmt: skip
    rows = np.concatenate([times[:, None], quats, places], 1).astype("<f8")
    way = _text("camera") + struct.pack("<BI", _LINEAR, len(times)) + rows.tobytes()
    return record(SENSOR, sensor) + record(TRAJECTORY, way)


def object_table(anchors: Mapping[int, np.ndarray]) -> bytes:
    """Return which objects there are, by their numbers, with a place [3] of each."""
    body = struct.pack("<IH", len(anchors), 0)
    for number, anchor in anchors.items():
        body += struct.pack("<I", number) + _text(f"object {number}") + struct.pack("<3fB", *anchor, 0)
    return record(OBJECT_TABLE, body)


def camera(fov: float, times: np.ndarray, places: np.ndarray, targets: np.ndarray) -> bytes:
    """Return the way of a view that players may begin with.

    Args:
        fov: degrees from its upper to its lower edge.
        times: [T] seconds.
        places: [T, 3]
        targets: [T, 3] what it looks at.
    """
    rows = np.concatenate([times[:, None], places, targets], 1).astype("<f8")
    first = _doubles(fov, *places[0], *targets[0])
    return record(CAMERA, first + struct.pack("<I", len(times)) + rows.tobytes() + _text("linear") + struct.pack("<B", 0))


def stream(attribute: int, values: np.ndarray, *, may_differ: bool = True) -> bytes:
    """Return integers [N] or [N, C] as a stream: all alike, as they are or as differences, whatever takes the least room.

    Args:
        attribute: its number.
        values: between -``MAX_BIN`` and ``MAX_BIN``.
        may_differ: differences may be stored.
    """
    values = np.asarray(values, np.int64)
    values = values.reshape(len(values), -1)
    count, channels = values.shape
    if count > 1 and (values == values[0]).all():
        choices = [(_CONSTANT, values[:1])]
    else:
        choices = [(_RAW, values)]
        if may_differ and count > 1:
            choices.append((_DELTA, np.diff(values, axis=0, prepend=0)))
    packed = []
    for mode, symbols in choices:
        # Without signs: 0, -1, 1, -2 and so on become 0, 1, 2, 3.
        unsigned = np.where(symbols < 0, -2 * symbols - 1, 2 * symbols).ravel()
        width = next(width for width in (1, 2, 4) if unsigned.max(initial=0) < 256**width)
        planes = unsigned.astype(f"<u{width}").view(np.uint8).reshape(-1, width).T
        packed.append((mode, width, zlib.compress(np.ascontiguousarray(planes).tobytes(), _LEVEL)))
    mode, width, body = min(packed, key=lambda choice: len(choice[2]))
    return struct.pack("<BBBBBIQ", attribute, width, mode, _DEFLATE, channels, count, len(body)) + body


def chunk(begin: float, end: float, level: int, count: int, streams: Iterable[bytes]) -> bytes:
    """Return the Gaussians of a time.

    Args:
        begin: seconds from which on some of them may be there.
        end: from which on none is.
        level: how often the clip was halved.
        count: how many there are.
        streams: of their attributes.
    """
    body = b"".join(streams)
    return record(
        CHUNK, struct.pack("<ddII", begin, end, level, count) + _text("") + struct.pack("<QQ", len(body), len(body)) + body
    )


def harmonics_band(band: int, values: np.ndarray) -> bytes:
    """Return one band of the harmonics of the chunk before: bytes [N, 3 (2 band + 1)], those of red first."""
    return record(SH_BAND, struct.pack("<B", band) + stream(SH_BAND, values))


@dataclass(frozen=True)
class ChunkPlace:
    """Where a chunk is in the file.

    Attributes:
        begin: of its interval, in seconds.
        end: of its interval.
        offset: of its record.
        length: of its record.
        count: Gaussians.
        bands: (number, offset, length) of each band.
    """

    begin: float
    end: float
    offset: int
    length: int
    count: int
    bands: list[tuple[int, int, int]]


def summary(places: Sequence[ChunkPlace], offset: int, count: int, duration: float, low: np.ndarray, high: np.ndarray) -> bytes:
    """Return the end of the file: where the chunks are, and where that stands.

    Args:
        places: of the chunks.
        offset: where it begins.
        count: Gaussians in all.
        duration: seconds.
        low: [3] the least of each coordinate.
        high: [3] the greatest.
    """
    body = b""
    for place in places:
        bands = b"".join(struct.pack("<BQQ", *band) for band in place.bands)
        about = struct.pack("<ddQQII", place.begin, place.end, place.offset, place.length, place.count, len(place.bands))
        body += record(CHUNK_INDEX, about + bands)
    body += record(STATISTICS, struct.pack("<QId", count, len(places), duration) + _doubles(*low, *high))
    return body + record(FOOTER, struct.pack("<QQI", offset if places else 0, 0, zlib.crc32(body))) + MAGIC
