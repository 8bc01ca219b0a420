"""The sound of a stretch of a film: as a file of its own, without loss at 16 bits, and for other encoders."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import av
import numpy as np

from flowsplat.common.files import atomic_path
from flowsplat.images.media import create_media, open_media
from flowsplat.images.video import SOUND_RATES, find_sound_track, read_sound_blocks


def keep_sound(source: Path, start: float, seconds: float, path: Path) -> bool:
    """Write ``seconds`` of the sound of a film from second ``start`` on as FLAC.

    Returns:
        whether there was any that can be read.

    Raises:
        InputError: the film is missing, or the file cannot be written.
    """
    try:
        container = open_media(source)
    except av.FFmpegError:
        return False
    with container:
        track = find_sound_track(container)
        if track is None:
            return False
        rate = track.rate if track.rate in SOUND_RATES else SOUND_RATES[-1]
        layout = "mono" if track.channels == 1 else "stereo"
        left = round(seconds * rate)
        with atomic_path(path) as temporary, create_media(temporary, "flac") as out:
            stream = out.add_stream("flac", rate=rate)
            stream.layout, stream.format = layout, "s16"
            encode_sound_blocks(out, stream, read_sound_blocks(container, track, start, rate, layout), left, "s16")
    return True


def encode_sound_blocks(
    out: av.container.OutputContainer,
    stream: av.AudioStream,
    blocks: Iterable[np.ndarray],
    count: int,
    samples: Literal["s16", "flt"],
) -> int:
    """Encode the first samples of a sound and end the stream; values are kept to [-1, 1], and are 0 where they are no numbers.

    Args:
        out: file that the stream is of.
        stream: its ``rate`` and ``layout`` are those of ``blocks``.
        blocks: (channels, samples) float each, as ``read_sound_blocks`` yields them.
        count: samples of a channel that are wanted at most.
        samples: what the encoder takes: whole numbers of 16 bits, or floats.

    Returns:
        samples of a channel that there were.
    """
    written = 0
    for block in blocks:
        block = block[:, : count - written]
        if block.shape[1]:
            values = np.clip(np.nan_to_num(block.T), -1, 1).reshape(1, -1)
            packed = np.rint(values * 32767).astype(np.int16) if samples == "s16" else np.ascontiguousarray(values, np.float32)
            frame = av.AudioFrame.from_ndarray(packed, samples, stream.layout)
            frame.sample_rate, frame.pts = stream.rate, written
            out.mux(stream.encode(frame))
            written += block.shape[1]
        if written >= count:
            break
    out.mux(stream.encode())
    return written
