"""The one reader of ``.npy`` and ``.npz`` files.

What an array is, its header says. It is looked at before anything of the array is read, so that a file of some bytes cannot ask for
gigabytes, and no pickle is ever opened.
"""

from __future__ import annotations

import bz2
import io
import math
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Protocol

import numpy as np

from flowsplat.common.errors import InputError, first_line
from flowsplat.common.files.opening import ordinary_file
from flowsplat.common.files.zip_file import open_zip
from flowsplat.common.syntax import PARSING

MAX_ARRAY_BYTES = 96 * 2**20
"""Of the arrays that are read from one file, where the caller does not know better. Chosen by eye."""
_KINDS = "biuf"
"""Truth values, whole numbers and floats: everything else needs pickle, or is not used by any format."""
_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2)
"""How NumPy and rig scenes pack."""
_MAX_AXIS_LENGTH = 2**31
"""Length of one axis of an array, at most (exclusive): what a signed 32-bit index reaches."""
_BOM = b"\x93NUMPY"


def read_npz(path: Path, names: Collection[str] | None = None, most: int = MAX_ARRAY_BYTES) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz``.

    Args:
        names: which of them, as far as they are there; None = all.
        most: bytes of all of them together.

    Raises:
        InputError: missing, not an ordinary file, damaged, with objects, or with larger arrays.
    """
    return open_zip(path, lambda archive: _read_members(path, archive, names, most))


def read_npy(path: Path, most: int = MAX_ARRAY_BYTES) -> np.ndarray:
    """Return the array of a ``.npy``, of at most ``most`` bytes.

    Raises:
        InputError: missing, not an ordinary file, damaged, with objects, or with a larger array.
    """
    size = ordinary_file(path)
    try:
        with open(path, "rb") as file:
            return _read_array(f"{path}", file, size, most)
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(f"There is not enough memory to read {path}.") from error
    except Exception as error:
        raise InputError(f"{path} is no readable .npy file (damaged or truncated): {first_line(error)}.") from error


def _read_members(path: Path, archive: zipfile.ZipFile, names: Collection[str] | None, most: int) -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {}
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        if names is not None and name not in names:
            continue
        if member.compress_type not in _PACKED:
            raise InputError(f"{path} is packed in a way that NumPy does not use: write it with numpy.savez.")
        with archive.open(member) as file:
            unpacked = _Bzip2(archive, member) if member.compress_type == zipfile.ZIP_BZIP2 else file
            arrays[name] = _read_array(f"{path}: {name}", unpacked, member.file_size, most)
        most -= arrays[name].nbytes
    return arrays


class _Readable(Protocol):
    def read(self, count: int, /) -> bytes: ...


class _Bzip2:
    """A member that is packed by bzip2, unpacked as far as it is read: ``zipfile`` unpacks all that some bytes hold."""

    def __init__(self, archive: zipfile.ZipFile, member: zipfile.ZipInfo):
        """Begin where the member's bytes begin, behind the header in front of them."""
        assert archive.fp is not None
        self._file, self._member = archive.fp, member
        self._unpacker, self._left, self._sum = bz2.BZ2Decompressor(), member.compress_size, 0
        self._file.seek(member.header_offset + 26)
        lengths = self._file.read(4)
        self._at = member.header_offset + 30 + int.from_bytes(lengths[:2], "little") + int.from_bytes(lengths[2:], "little")

    def read(self, count: int, /) -> bytes:
        parts, missing = [], count
        while missing and not self._unpacker.eof:
            packed = b""
            if self._unpacker.needs_input:
                self._file.seek(self._at)
                packed = self._file.read(min(2**16, self._left))
                if not packed:
                    break
                self._at, self._left = self._at + len(packed), self._left - len(packed)
            parts.append(self._unpacker.decompress(packed, missing))
            self._sum = zlib.crc32(parts[-1], self._sum)
            missing -= len(parts[-1])
        if self._unpacker.eof and self._sum != self._member.CRC:
            raise zipfile.BadZipFile("its checksum is wrong")
        return b"".join(parts)


def _read_array(where: str, file: _Readable, size: int, most: int) -> np.ndarray:
    """Return one array of ``size`` bytes with its header."""
    head = file.read(8)
    if head[:6] != _BOM:
        raise InputError(f"{where} is damaged or no array.")
    long = head[6] >= 2
    stored = file.read(4 if long else 2)
    length = int.from_bytes(stored, "little")
    if head[6] not in (1, 2) or length > 10_000:
        raise InputError(f"{where} is damaged: its header is none.")
    header = io.BytesIO(head + stored + file.read(length))
    header.seek(8)
    read = np.lib.format.read_array_header_2_0 if long else np.lib.format.read_array_header_1_0
    with PARSING:
        shape, is_fortran, dtype = read(header)
    if dtype.hasobject or dtype.kind not in _KINDS or dtype.names is not None:
        raise InputError(f"{where} holds {dtype} and not numbers.")
    if not all(0 <= axis < _MAX_AXIS_LENGTH for axis in shape) or len(shape) > 8:
        raise InputError(f"{where} is damaged: it has shape {shape!s:.100}.")
    needed = math.prod(shape) * dtype.itemsize
    if needed > most:
        raise InputError(f"{where} has {needed / 2**20:,.1f} MiB, more than the {max(most, 0) / 2**20:,.1f} MiB that fit here.")
    if needed > size:
        raise InputError(f"{where} is damaged or truncated: it has {size:,} bytes and its header names {needed:,}.")
    data = bytearray(needed)
    view, filled = memoryview(data), 0
    while filled < needed and (block := file.read(min(needed - filled, 2**20))):
        view[filled : filled + len(block)] = block
        filled += len(block)
    if filled < needed:
        raise InputError(f"{where} is damaged or truncated: it ends after {filled:,} of {needed:,} bytes.")
    file.read(1)  # a zip compares its checksum where a member ends
    if not dtype.itemsize or not needed:
        return np.zeros(shape, dtype)
    array = np.frombuffer(data, dtype).reshape(shape, order="F" if is_fortran else "C")
    array = array.astype(dtype.newbyteorder("="), copy=False)
    if dtype.kind in "fc":
        # A NaN may ask for a warning at the first arithmetic done with it: from here on it is like all others.
        array[np.isnan(array)] = np.nan
    return array
