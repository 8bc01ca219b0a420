"""The sound of a scene as formats of others hold it: Opus in an Ogg file."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import av

from flowsplat.images.media import open_media
from flowsplat.images.sound import encode_sound_blocks
from flowsplat.images.video import find_sound_track, read_sound_blocks

RATE = 48000
"""Samples a second of Opus."""
BITS_A_CHANNEL = 64_000
"""Bits a second of a channel: what is called transparent. Chosen by eye."""


@dataclass(frozen=True)
class OpusSound:
    """A file, as bytes.

    Attributes:
        data: the file.
        layout: ``mono`` or ``stereo``.
        seconds: how long it is.
    """

    data: bytes
    layout: str
    seconds: float


def encode_sound(path: Path, start: float, seconds: float) -> OpusSound | None:
    """Return ``seconds`` of a file's sound from second ``start`` on; None where there is none that can be read or written.

    Raises:
        InputError: the file is missing.
    """
    try:
        container = open_media(path)
        with container:
            track = find_sound_track(container)
            if track is None:
                return None
            layout = "mono" if track.channels == 1 else "stereo"
            memory = io.BytesIO()
            # Without ``bitexact`` the numbers of its streams are random.
            with av.open(memory, "w", format="ogg", options={"fflags": "+bitexact"}) as out:
                stream = out.add_stream("libopus", rate=RATE)
                stream.layout = layout
                stream.bit_rate = BITS_A_CHANNEL * (1 if layout == "mono" else 2)
                blocks = read_sound_blocks(container, track, start, RATE, layout)
                written = encode_sound_blocks(out, stream, blocks, round(seconds * RATE), "flt")
    except (av.FFmpegError, av.codec.codec.UnknownCodecError):
        return None
    return OpusSound(memory.getvalue(), layout, written / RATE) if written else None
