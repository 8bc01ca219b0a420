"""Opening files that come from anywhere: only ordinary ones, and no larger than their kind can need."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from flowsplat.common.errors import InputError

MAX_TEXT_BYTES = 64 * 2**20
"""Bytes of a text file. Chosen by eye."""

_KINDS = {
    stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
}  # fmt: skip


def ordinary_file(path: Path, most: int | None = None) -> int:
    """Return the size of a file in bytes, once it is certain that it is one and not larger than ``most``.

    Devices and pipes never end or block for ever; a link counts as what it leads to.

    Raises:
        InputError: missing, not an ordinary file, or too large.
    """
    try:
        found = os.stat(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise InputError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:  # a name with NUL is a ValueError
        raise InputError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}.") from error
    kind = stat.S_IFMT(found.st_mode)
    if kind != stat.S_IFREG:
        raise InputError(f"{path} is {_KINDS.get(kind, 'something else')}, not a file.")
    if most is not None and found.st_size > most:
        raise InputError(f"{path} has {_size(found.st_size)}, more than the {_size(most)} that such a file can need.")
    return found.st_size


def read_bytes(path: Path, most: int = MAX_TEXT_BYTES) -> bytes:
    """Return all of a file, see ``ordinary_file``.

    Raises:
        InputError: missing, not an ordinary file, too large, or it cannot be read.
    """
    ordinary_file(path, most)
    try:
        with open(path, "rb") as file:
            # Room for all that is asked for is made at once, so no more is asked for than is there.
            data = file.read(min(os.fstat(file.fileno()).st_size, most) + 1)
            while len(data) <= most and (more := file.read(2**16)):  # it has grown since
                data += more
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    if len(data) > most:
        raise InputError(f"{path} has more than the {_size(most)} that such a file can need.")
    return data


def read_text(path: Path, most: int = MAX_TEXT_BYTES) -> str:
    """Return all of a file of UTF-8.

    Raises:
        InputError: as ``read_bytes``, or it is no text.
    """
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text in UTF-8 (byte {error.start}).") from error


def _size(count: int) -> str:
    return f"{count / 2**20:,.1f} MiB" if count >= 2**20 else f"{count:,} bytes"
