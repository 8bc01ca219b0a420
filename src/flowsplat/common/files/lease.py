"""Lock what one process at a time may have: folders to write into (``lease``), and pieces of work of a list (``Claims``).

``lease``: a file in the folder is locked (``locks``) as long as the process lives: the system unlocks it however the process
ends, and over NFS for the other machines, too. So there is nothing to be renewed, and nothing of a dead holder to be cleaned away;
what is written in the file only tells others who it is. Who reads the folder takes no notice of it.

``Claims``: for machines that share a folder, also one without locks. The right to an attempt of a piece of work is a file that only
one of them can create; its holder touches it again and again, and where it stays untouched, the next attempt is anybody's.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import threading
import time
import uuid
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from flowsplat.common.errors import InputError, InUseError
from flowsplat.common.files.locks import NoLocksError, has_locks, is_locked, open_to_lock, remove_locked, try_lock
from flowsplat.common.files.writing import make_folder, make_writing_error
from flowsplat.common.process_control import read_number_space, read_start_time

NAME = ".lock"
_MAX_HOLDER_BYTES = 1000
"""Bytes of the file. Chosen by eye."""

BEAT_SECONDS = 15.0
"""Seconds between two signs of life of who holds a claim. Chosen by eye."""
DEAD_SECONDS = 120.0
"""Seconds without one after which a holder on another machine counts as dead; on its own it is asked for by its number.
Chosen by eye."""

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
            remove_locked(taken, folder / NAME)
        if not was_there:
            with contextlib.suppress(OSError):
                folder.rmdir()  # only where nothing is in it


def holder(folder: Path) -> str | None:
    """Return who has a folder, in words; None where nobody does, or another system cannot tell."""
    if not has_locks():
        return None
    try:
        file = open_to_lock(folder / NAME, create=False)
    except OSError:
        return None
    try:
        if not stat.S_ISREG(os.fstat(file).st_mode):
            return None
        return _decode_holder(os.read(file, _MAX_HOLDER_BYTES)) if is_locked(file) else None
    finally:
        os.close(file)


def _take(folder: Path) -> int | None:
    """Return the locked file; None where there are no locks."""
    if not has_locks():
        return None
    path = folder / NAME
    while True:
        try:
            file = open_to_lock(path, create=True)
        except OSError as error:
            raise make_writing_error(error, path) from error
        if not stat.S_ISREG(os.fstat(file).st_mode):
            os.close(file)
            raise InputError(f"{path} is no ordinary file: remove it.")
        try:
            locked = try_lock(file)
        except NoLocksError:
            remove_locked(file, path)
            return None
        if not locked:
            who = _decode_holder(os.read(file, _MAX_HOLDER_BYTES))
            os.close(file)
            raise InUseError(f"{folder} is being written by {who}: wait for it, or stop it.")
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(file), os.stat(path)):  # else its last holder has just removed it
                value = {"host": socket.gethostname(), "process": os.getpid(), "since": time.time()}
                os.ftruncate(file, 0)
                os.lseek(file, 0, os.SEEK_SET)
                os.write(file, json.dumps(value).encode())
                return file
        os.close(file)


def _decode_holder(data: bytes) -> str:
    """Return a holder; whatever stands in its file."""
    try:
        value = json.loads(data)
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(float(value["since"])))
        return f"process {int(value['process'])} on {str(value['host'])[:100]} since {since}"
    except (ValueError, KeyError, TypeError, OverflowError, OSError, RecursionError):
        return "another process"


class Claims:
    """Which pieces of work this process has, of those that any number of processes on any number of machines share.

    The right to attempt ``number`` (1, 2, ...) of a piece is the file ``<name>.<number>`` in the folder of the claims, created with
    ``O_EXCL``: one process can. While it holds it, a thread touches the file every ``beat`` seconds. Where the holder is dead,
    attempt ``number + 1`` may be taken. So a number is never given twice, and whoever comes back from a long sleep finds a higher
    one and knows that the work is no longer its own (``has``). Callers record the number with the result of an attempt and look
    there after ``take``: the files of ended attempts go.

    Clocks of machines are never compared: a claim is dead when it has not changed for ``lost`` seconds by the clock of who looks.
    """

    def __init__(self, folder: Path, beat: float = BEAT_SECONDS, lost: float = DEAD_SECONDS, place: str | None = None):
        """
        Args:
            folder: of the files; it is made.
            place: where process numbers mean the same; None = this machine since it was started.

        Raises:
            InputError: it cannot be made.
        """
        self._folder, self._beat, self._patience = make_folder(folder), beat, lost
        self._place = _place() if place is None else place
        self._token = uuid.uuid4().hex
        self._mine: dict[str, int] = {}
        self._lost_ones: set[str] = set()
        self._known: dict[tuple[str, int], dict[str, Any]] = {}
        self._seen: dict[tuple[str, int], tuple[int, float]] = {}
        self._guard, self._closed = threading.Lock(), threading.Event()
        threading.Thread(target=self._live, daemon=True).start()

    def take(self, name: str, number: int) -> bool:
        """Try to get an attempt, of whose predecessor the caller knows that it has ended or is dead; False where another has it.

        Raises:
            WritingError: the file cannot be written.
        """
        path = self._path(name, number)
        value = {"host": socket.gethostname(), "place": self._place, "process": os.getpid(), "started":
        read_start_time(os.getpid()),
                 "token": self._token, "since": time.time()}  # fmt: skip
        try:
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        except FileExistsError:
            return False
        except OSError as error:
            raise make_writing_error(error, path) from error
        try:
            with os.fdopen(file, "wb") as opened:
                opened.write(json.dumps(value).encode())
        except OSError as error:
            with contextlib.suppress(OSError):
                path.unlink()
            raise make_writing_error(error, path) from error
        with self._guard:
            self._mine[name] = number
        return True

    def release(self, name: str) -> None:
        """Give back what this process holds of a piece; the files of earlier attempts, whose holders are dead, go, too."""
        with self._guard:
            number = self._mine.pop(name)
            self._lost_ones.discard(name)
        for earlier in range(number, 0, -1):
            with contextlib.suppress(OSError):
                self._path(name, earlier).unlink()

    def has(self, name: str) -> bool:
        """Return whether this process still holds a piece: nobody has taken it for dead."""
        with self._guard:
            number = self._mine.get(name)
        return number is not None and self._is_ours(name, number)

    def list_lost(self) -> list[str]:
        """Return what somebody else has taken meanwhile, as far as the last beat told."""
        with self._guard:
            return list(self._lost_ones)

    def newest(self) -> dict[str, int]:
        """Return the highest attempt of every piece of which there is a file."""
        found: dict[str, int] = {}
        try:
            names = os.listdir(self._folder)
        except OSError:
            names = []
        for file in names:
            name, _, number = file.rpartition(".")
            if name and number.isdecimal() and len(number) < 10:
                found[name] = max(found.get(name, 0), int(number))
        return found

    def is_dead(self, name: str, number: int) -> bool:
        """Return whether the holder of an attempt of another process is dead, as far as is known by now: ask again."""
        path = self._path(name, number)
        try:
            changed = os.stat(path).st_mtime_ns
        except OSError:
            return False  # it has just ended
        who = self._holder(name, number)
        if who.get("token") == self._token:
            return False
        if who.get("place") == self._place and isinstance(who.get("process"), int):
            return read_start_time(who["process"]) != who.get("started")
        now = time.monotonic()
        before = self._seen.get((name, number))
        if before is None or before[0] != changed:
            self._seen[name, number] = (changed, now)
            return False
        return now - before[1] > self._patience

    def who(self, name: str, number: int) -> str:
        """Return the holder of an attempt, in words."""
        try:
            return _decode_holder(self._path(name, number).read_bytes()[:_MAX_HOLDER_BYTES])
        except OSError:
            return "another process"

    def close(self) -> None:
        """Give back everything."""
        self._closed.set()
        for name in list(self._mine):
            self.release(name)

    def _path(self, name: str, number: int) -> Path:
        return self._folder / f"{name}.{number}"

    def _holder(self, name: str, number: int) -> dict[str, Any]:
        """Return what stands in the file of an attempt, which does not change once it stands there."""
        if (name, number) not in self._known:
            try:
                value = json.loads(self._path(name, number).read_bytes()[:_MAX_HOLDER_BYTES])
            except (OSError, ValueError, RecursionError):
                return {}
            if not isinstance(value, dict):
                return {}
            self._known[name, number] = value
        return self._known[name, number]

    def _is_ours(self, name: str, number: int) -> bool:
        if self._path(name, number + 1).exists():
            return False
        try:
            value = json.loads(self._path(name, number).read_bytes()[:_MAX_HOLDER_BYTES])
        except (OSError, ValueError, RecursionError):
            return False
        return isinstance(value, dict) and value.get("token") == self._token

    def _live(self) -> None:
        while not self._closed.wait(self._beat):
            with self._guard:
                mine = list(self._mine.items())
            for name, number in mine:
                with contextlib.suppress(OSError):  # gone, or the folder is away for now
                    os.utime(self._path(name, number))
                if not self._is_ours(name, number):
                    with self._guard:
                        if self._mine.get(name) == number:
                            self._lost_ones.add(name)


@cache
def _place() -> str:
    """This machine since it was started, and, in a container, this container: where process numbers mean the same."""
    return " ".join([socket.gethostname(), *read_number_space()])
