"""Folders that one process at a time writes into.

A file in the folder is locked (``flock``) as long as the process lives: the system unlocks it however the process ends, and over
NFS for the other machines, too. So there is nothing to be renewed, and nothing of a dead holder to be cleaned away; what is written
in the file only tells others who it is. Who reads the folder takes no notice of it. Windows has no ``flock``; nothing is locked
there.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat.common.files.writing import make_folder, writing_error

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

NAME = ".lock"
_MOST_HOLDER = 1000
"""Bytes of the file."""

_held: dict[tuple[int, int], int] = {}
"""How often this process has taken what it holds, by device and number of the folder."""
_GUARD = threading.Lock()


@contextlib.contextmanager
def lease(folder: Path) -> Iterator[None]:
    """Have a folder alone while the block runs; it is made, and goes again where it is still empty in the end.

    The process that has it may take it again, within the block.

    Raises:
        InputError: another process has it: the message names it; or the folder cannot be made or written.
    """
    was_there = os.path.lexists(folder)
    folder = make_folder(folder)
    found = os.stat(folder)
    key = (found.st_dev, found.st_ino)
    with _GUARD:
        again = key in _held
        taken = None if again else _take(folder)
        _held[key] = _held.get(key, 0) + 1
    try:
        yield
    finally:
        with _GUARD:
            _held[key] -= 1
            if not _held[key]:
                del _held[key]
        if taken is not None:
            with contextlib.suppress(OSError):
                (folder / NAME).unlink()
            os.close(taken)
        if not was_there:
            with contextlib.suppress(OSError):
                folder.rmdir()  # only where nothing is in it


def holder(folder: Path) -> str | None:
    """Who has a folder, in words; None where nobody does, or another system cannot tell."""
    if fcntl is None:
        return None
    try:
        file = os.open(folder / NAME, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        if not stat.S_ISREG(os.fstat(file).st_mode):
            return None
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return _in_words(os.read(file, _MOST_HOLDER))
        return None
    finally:
        os.close(file)


def _take(folder: Path) -> int | None:
    """The locked file; None where there are no locks."""
    if fcntl is None:
        return None
    path = folder / NAME
    while True:
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise writing_error(error, path) from error
        if not stat.S_ISREG(os.fstat(file).st_mode):
            os.close(file)
            raise InputError(f"{path} is no ordinary file: remove it.")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            who = _in_words(os.read(file, _MOST_HOLDER))
            os.close(file)
            raise InputError(f"{folder} is being written by {who}: wait for it, or stop it.") from error
        except OSError:  # a file system without locks
            os.close(file)
            with contextlib.suppress(OSError):
                path.unlink()
            return None
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(file), os.stat(path)):  # else its last holder has just removed it
                value = {"host": socket.gethostname(), "process": os.getpid(), "since": time.time()}
                os.ftruncate(file, 0)
                os.pwrite(file, json.dumps(value).encode(), 0)
                return file
        os.close(file)


def _in_words(data: bytes) -> str:
    """A holder; whatever stands in its file."""
    try:
        value = json.loads(data)
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(float(value["since"])))
        return f"process {int(value['process'])} on {str(value['host'])[:100]} since {since}"
    except (ValueError, KeyError, TypeError, OverflowError, OSError, RecursionError):
        return "another process"
