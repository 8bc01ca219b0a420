"""Receive clips: each is written to disk as it comes, is never larger than allowed, and is gone where it does not come whole."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import time
from pathlib import Path
from typing import BinaryIO

from flowsplat.common.errors import InputError
from flowsplat.common.files import plain_name

MAX_PARALLEL = 2
"""Clips that are received at a time. Chosen by eye."""
SILENCE_SECONDS = 60.0
"""Seconds without a byte after which a clip is given up. Chosen by eye."""
DISK_RESERVE = 1_000_000_000
"""Bytes of the disk that have to stay free. Chosen by eye."""
_PREFIX = ".receiving-"


class Refusal(InputError):
    """A clip is not received.

    Attributes:
        status: of HTTP.
    """

    def __init__(self, status: int, message: str):
        super().__init__(message)
        self.status = status


class Upload:
    """One clip that is on its way. ``close`` must be called in the end; what is not taken by then is deleted."""

    def __init__(self, uploads: Uploads, name: str, place: Path):
        self.name, self.place = name, place
        self._uploads, self._size, self.heard = uploads, 0, time.monotonic()
        self._file: BinaryIO | None = place.open("xb")

    def write(self, data: bytes) -> None:
        """Keep what has come.

        Raises:
            Refusal: it is more than is allowed, or than there is room for.
        """
        assert self._file is not None
        self._size += len(data)
        self.heard = time.monotonic()
        if self._size > self._uploads.max_bytes:
            raise self._uploads.too_large()
        try:
            self._file.write(data)
        except OSError as error:
            raise Refusal(507, f"The clip cannot be kept: {error.strerror or error}.") from error

    def finish(self) -> None:
        """All has come.

        Raises:
            Refusal: nothing has, or the disk is full.
        """
        assert self._file is not None
        file, self._file = self._file, None
        try:
            file.close()
        except OSError as error:
            raise Refusal(507, f"The clip cannot be kept: {error.strerror or error}.") from error
        if not self._size:
            raise Refusal(400, f"{self.name} is empty.")

    def close(self) -> None:
        """Delete it, unless it was moved elsewhere."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None
        shutil.rmtree(self.place.parent, ignore_errors=True)
        self._uploads.under_way.discard(self)

    @property
    def is_silent(self) -> bool:
        """Whether nothing has come for long."""
        return self._file is not None and time.monotonic() - self.heard > SILENCE_SECONDS


class Uploads:
    """All clips that are on their way into a studio."""

    def __init__(self, studio: Path, max_bytes: int):
        """
        Args:
            studio: its folder; what an earlier server has left of clips on their way is deleted.
            max_bytes: of a clip.
        """
        self._studio, self.max_bytes = studio, max_bytes
        self.under_way: set[Upload] = set()
        for path in studio.glob(f"{_PREFIX}*"):
            shutil.rmtree(path, ignore_errors=True)

    def begin(self, name: str, size: int | None) -> Upload:
        """Return what is to receive a clip.

        Args:
            name: of its file.
            size: bytes, as far as that is said.

        Raises:
            Refusal: its name cannot be one, it is too large, others are on their way, or the disk is full.
        """
        try:
            name = plain_name(name, "The clip's name")
        except InputError as error:
            raise Refusal(400, str(error)) from error
        if size is not None and size > self.max_bytes:
            raise self.too_large()
        if len(self.under_way) >= MAX_PARALLEL:
            raise Refusal(429, f"{MAX_PARALLEL} clips are on their way already: wait until one has arrived.")
        free = shutil.disk_usage(self._studio).free - DISK_RESERVE
        if free < (size or 0):
            raise Refusal(507, f"There is no room for it: the disk has {max(free, 0) / 1e9:.1f} GB left.")
        folder = self._studio / f"{_PREFIX}{os.getpid()}-{secrets.token_hex(8)}"
        try:
            folder.mkdir()
            found = Upload(self, name, folder / name)
        except OSError as error:
            shutil.rmtree(folder, ignore_errors=True)
            raise Refusal(507, f"The clip cannot be kept: {error.strerror or error}.") from error
        self.under_way.add(found)
        return found

    def too_large(self) -> Refusal:
        """Return what is said of a clip that is."""
        return Refusal(413, f"The clip is larger than {self.max_bytes / 1e9:.3g} GB: cut it first, or start with --max-upload-gb.")

    def close(self) -> None:
        """Give all of them up."""
        for upload in list(self.under_way):
            upload.close()
