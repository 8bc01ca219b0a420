"""The one reader of zips: their directory is looked at before it is read as a whole, and no member unpacks to more than it says."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, TypeVar

from flowsplat.common.errors import InputError, first_line
from flowsplat.common.files.opening import ordinary_file

_MAX_ZIP_MEMBERS = 4096
"""Files in a zip, at most. A round number, against archives made to exhaust memory."""
_MAX_ZIP_DIRECTORY_BYTES = 2**20
"""Bytes of a zip's directory. Chosen by eye."""

_T = TypeVar("_T")


def open_zip(path: Path, read: Callable[[zipfile.ZipFile], _T]) -> _T:
    """Return what ``read`` makes of a zip.

    Raises:
        InputError: missing, not an ordinary file, or damaged.
    """
    ordinary_file(path)
    try:
        with open(path, "rb") as file:
            _check_directory(path, file)
            with zipfile.ZipFile(file) as archive:
                return read(archive)
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(f"There is not enough memory to read {path}.") from error
    # What damage makes of the zip, of zlib and of NumPy's parser of headers is no list to be kept here.
    except Exception as error:
        raise InputError(f"{path} is damaged or truncated: {first_line(error)}.") from error


def list_zip(path: Path) -> list[str]:
    """Return the names of the files in a zip, see ``open_zip``."""
    return open_zip(path, lambda archive: archive.namelist())


def read_zip(path: Path, name: str, most: int) -> bytes:
    """Return all of a file of at most ``most`` bytes in a zip.

    Raises:
        InputError: as ``open_zip``, or it is not in it, too large, or packed in a rare way.
    """

    def read(archive: zipfile.ZipFile) -> bytes:
        member = archive.getinfo(name)
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError(f"{path} is packed in a rare way: pack it with deflate.")
        if member.file_size > most:
            raise InputError(f"{path}: {name} has {member.file_size:,} bytes, more than the {most:,} that it can need.")
        with archive.open(member) as file:
            return file.read(member.file_size + 1)  # the checksum is compared at the end

    return open_zip(path, read)


def _check_directory(path: Path, file: IO[bytes]) -> None:
    """Refuse a zip whose directory alone would fill the memory: it is read as a whole when the zip is opened."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - 66_000, 0))  # the last record may be followed by a comment of 65,535 bytes
    tail = file.read()
    at = tail.rfind(b"PK\x05\x06")
    if at < 0 or len(tail) < at + 22:
        raise InputError(f"{path} is damaged or truncated: it is no zip file.")
    members, bytes_of_directory = (int.from_bytes(tail[at + a : at + b], "little") for a, b in ((10, 12), (12, 16)))
    if members > _MAX_ZIP_MEMBERS or bytes_of_directory > _MAX_ZIP_DIRECTORY_BYTES or tail[max(at - 20, 0) :][:4] == b"PK\x06\x07":
        raise InputError(f"{path} is damaged: it lists more arrays than such a file can hold.")
    file.seek(0)
