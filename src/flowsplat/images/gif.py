"""Frames to an animated GIF that loops for ever, with colors chosen for these frames."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import av.video
import numpy as np

from flowsplat.common.files import atomic_path
from flowsplat.images.media import create_media


def write_gif(path: Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Write RGB frames [H, W, 3] uint8, all of one size.

    GIF counts time in hundredths of a second: the frame rate is the nearest that it can say.

    Raises:
        InputError: the file cannot be written.
        ValueError: no frames.
    """
    if not frames:
        raise ValueError("a GIF needs at least one frame")
    rate = Fraction(100, max(round(100 / fps), 1))
    height, width = frames[0].shape[:2]
    with atomic_path(path) as temporary, create_media(temporary, "gif", {"loop": "0"}) as container:
        stream = container.add_stream("gif", rate=rate)
        assert isinstance(stream, av.video.VideoStream)
        stream.width, stream.height, stream.pix_fmt = width, height, "pal8"
        for number, frame in enumerate(_with_palette(frames, rate)):
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _with_palette(frames: Sequence[np.ndarray], rate: Fraction) -> list[av.VideoFrame]:
    """Return the frames in the 256 colors that suit them together."""
    height, width = frames[0].shape[:2]
    graph = av.filter.Graph()
    source = graph.add_buffer(width=width, height=height, format=av.VideoFormat("rgb24"), time_base=1 / rate)
    split, palette = graph.add("split"), graph.add("palettegen", "stats_mode=full")
    use = graph.add("paletteuse", "dither=sierra2_4a")
    sink = graph.add("buffersink")
    source.link_to(split)
    split.link_to(palette, 0, 0)
    split.link_to(use, 1, 0)
    palette.link_to(use, 0, 1)
    use.link_to(sink)
    graph.configure()
    for number, image in enumerate(frames):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame.pts, frame.time_base = number, 1 / rate
        source.push(frame)
    source.push(None)
    found: list[av.VideoFrame] = []
    while len(found) < len(frames):
        found.append(sink.pull())
    return found
