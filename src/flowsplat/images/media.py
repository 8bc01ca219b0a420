"""Opening films and sounds, to read and to write: what FFmpeg is given is a file, and it may open nothing else.

To FFmpeg a name is an address: ``http://...`` is fetched, ``12:30.mp4`` is of a protocol called 12, and playlists name further
files.
"""

from __future__ import annotations

from pathlib import Path

import av
from av.container import InputContainer, OutputContainer

from flowsplat.common.errors import InputError
from flowsplat.common.files import ordinary_file
from flowsplat.images.header import MAX_PIXELS

_LISTS = {"hls", "dash", "concat", "concatf", "imf", "rtsp", "sdp", "image2"}
"""Formats that consist of other files."""
_METADATA = {"metadata_errors": "replace"} if int(av.__version__.partition(".")[0]) < 19 else {}
"""Titles that are no UTF-8 are no reason to refuse a film. PyAV 19 takes them as they come, and no longer knows the word."""


def open_media(path: Path) -> InputContainer:
    """Return a film or a sound on this machine.

    Raises:
        InputError: missing, not an ordinary file, with images that are too large, or a list of other files.
        av.FFmpegError: it cannot be read.
    """
    ordinary_file(path)
    container = av.open(_address(path), options={"protocol_whitelist": "file"}, **_METADATA)
    if set(container.format.name.split(",")) & _LISTS:
        container.close()
        raise InputError(f"{path} is a list of other files: give one of these.")
    for stream in container.streams.video:
        context = stream.codec_context
        if context is None:  # of a kind that is not known
            continue
        if context.width * context.height > MAX_PIXELS:
            container.close()
            raise InputError(
                f"{path} has {context.width:,} x {context.height:,} pixels, "
                f"more than the {MAX_PIXELS / 1e6:g} million that are read."
            )
        # Frames may have another size than they are said to have.
        context.options = {**context.options, "max_pixels": str(MAX_PIXELS)}
    return container


def create_media(path: Path, kind: str | None = None, options: dict[str, str] | None = None) -> OutputContainer:
    """Return a film or a sound that is written to a file.

    Args:
        kind: FFmpeg's name of the format; None takes that of the file's ending.
        options: of the format.

    Raises:
        av.FFmpegError: it cannot be written. Those of the system are an OSError, too.
    """
    return av.open(_address(path), "w", format=kind, options=options)


def _address(path: Path) -> str:
    """Return a file's name as FFmpeg takes it for nothing else."""
    return f"file:{Path(path).absolute()}"
