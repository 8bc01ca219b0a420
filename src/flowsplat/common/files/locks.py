"""Lock an open file, as long as it is open and the process lives.

Linux and macOS: ``flock``, which does not hinder who reads the file. Windows: a byte far behind what the file holds
(``msvcrt.locking``), as a locked byte can be read by nobody; it knows no lock that several may have. Elsewhere nothing is locked.
"""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
try:
    import msvcrt
except ImportError:
    msvcrt = None  # type: ignore[assignment]

_OPENING = ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_NOINHERIT", "O_BINARY")
"""What is asked for where the system has it: no link, no waiting for a pipe, nothing handed on, no line ends changed."""
_LOCKED_BYTE = 2**30
"""Where the byte lies that Windows locks."""
_LOOKS = 5
"""How often a lock is asked for on Windows, where whoever only looks has it for a moment."""
_LOOK_SECONDS = 0.02
"""Seconds between two of them. Chosen by eye."""


class NoLocksError(Exception):
    """The system or the file system has none."""


def has_locks() -> bool:
    """Return whether the system has locks."""
    return fcntl is not None or msvcrt is not None


def open_to_lock(path: Path, create: bool) -> int:
    """Return the number of an open file: to read and write, made where it is not there, or only to read.

    Raises:
        OSError: it cannot be opened, or is a link.
    """
    flags = (os.O_RDWR | os.O_CREAT) if create else os.O_RDONLY
    if msvcrt is not None and fcntl is None:
        flags = flags | os.O_RDWR  # a lock needs it there
    for name in _OPENING:
        flags |= getattr(os, name, 0)
    return os.open(path, flags, 0o644)


def try_lock(file: int) -> bool:
    """Lock an open file for this one alone; False where somebody else has it.

    Raises:
        NoLocksError: see there.
    """
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as error:
            raise NoLocksError from error
        return True
    for k in range(_LOOKS):
        if k:
            time.sleep(_LOOK_SECONDS)
        if _lock_byte(file, lock=True):
            return True
    return False


def is_locked(file: int) -> bool:
    """Return whether somebody has locked an open file; False where there are no locks."""
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return True
        return False
    if msvcrt is None:
        return False
    if not _lock_byte(file, lock=True):
        return True
    _lock_byte(file, lock=False)
    return False


def _lock_byte(file: int, lock: bool) -> bool:
    if msvcrt is None:
        raise NoLocksError
    at = os.lseek(file, 0, os.SEEK_CUR)
    try:
        os.lseek(file, _LOCKED_BYTE, os.SEEK_SET)
        msvcrt.locking(file, msvcrt.LK_NBLCK if lock else msvcrt.LK_UNLCK, 1)  # type: ignore[attr-defined,unused-ignore]
    except OSError:
        return False
    finally:
        os.lseek(file, at, os.SEEK_SET)
    return True


def remove_locked(file: int, path: Path) -> None:
    """Delete a file that is locked here, and close it. Windows deletes no file that is open: there it is closed first, and stays
    where somebody else has opened it meanwhile."""
    if fcntl is not None:
        with contextlib.suppress(OSError):
            path.unlink()
        os.close(file)
        return
    os.close(file)
    with contextlib.suppress(OSError):
        path.unlink()
