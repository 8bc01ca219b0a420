"""The sound of a stretch of a film as a file of its own, without loss at 16 bits."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np

from flowsplat.common.files import atomic_path
from flowsplat.images.media import open_media
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
        with atomic_path(path) as temporary, av.open(str(temporary), "w", format="flac") as out:
            stream = out.add_stream("flac", rate=rate)
            stream.layout, stream.format = layout, "s16"
            written = 0
            for block in read_sound_blocks(container, track, start, rate, layout):
                block = block[:, : left - written]
                if block.shape[1]:
                    samples = np.rint(np.clip(np.nan_to_num(block.T), -1, 1) * 32767).astype(np.int16).reshape(1, -1)
                    frame = av.AudioFrame.from_ndarray(samples, "s16", layout)
                    frame.sample_rate, frame.pts = rate, written
                    out.mux(stream.encode(frame))
                    written += block.shape[1]
                if written >= left:
                    break
            out.mux(stream.encode())
    return True
