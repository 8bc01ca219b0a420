"""Frames with transparency to a WebM: VP9 with alpha, which browsers and editors lay over other images."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import av.video
import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import atomic_path
from flowsplat.images.media import create_media

_BT709, _LIMITED, _FULL = 1, 1, 2
"""As in ``images.video``."""
_CRF = 24
"""VP9's constant quality, lower is better and larger. Chosen by eye."""
_REPRODUCIBLE = {"fflags": "+bitexact"}
"""Without a random number as the name of the file in it: the same images make the same file."""


@contextlib.contextmanager
def webm_writer(path: Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Yield a function that appends one frame [H, W, 4] uint8 (RGB not multiplied by alpha); whole when the block ends.

    An odd width or height is padded by a transparent column or row, because yuva420p needs even sizes.

    Raises:
        InputError: the file cannot be written, or this PyAV cannot encode VP9.
        ValueError: no frames, or frames of different sizes or types.
    """
    rate = Fraction(fps).limit_denominator(1001)
    with atomic_path(path) as temporary, create_media(temporary, options=_REPRODUCIBLE) as container:
        try:
            stream = container.add_stream("libvpx-vp9", rate=rate, options={"crf": str(_CRF), "b": "0", "cpu-used": "4"})
        except (ValueError, av.FFmpegError) as error:
            raise InputError("This PyAV cannot encode VP9. Install the one from PyPI: pip install --force av.") from error
        assert isinstance(stream, av.video.VideoStream)
        stream.pix_fmt = "yuva420p"
        # https://www.webmproject.org/docs/container/: without it players ignore the alpha.
        stream.metadata["alpha_mode"] = "1"
        context = stream.codec_context
        context.time_base = 1 / rate
        context.color_range = _LIMITED
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        shape: tuple[int, ...] = ()
        count = 0

        def write(image: np.ndarray) -> None:
            nonlocal shape, count
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 4:
                raise ValueError(f"a frame must be [H, W, 4] uint8, not {image.shape} {image.dtype}")
            if not count:
                shape = image.shape
                stream.height, stream.width = (size + size % 2 for size in shape[:2])
            if image.shape != shape:
                raise ValueError(f"frame {count} has shape {image.shape}, the first one {shape}")
            padded = np.pad(image, ((0, shape[0] % 2), (0, shape[1] % 2), (0, 0)))
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(padded), format="rgba")
            frame = frame.reformat(format="yuva420p", src_color_range=_FULL, dst_color_range=_LIMITED, dst_colorspace=_BT709)
            frame.color_range, frame.colorspace = _LIMITED, _BT709
            frame.pts, frame.time_base = count, 1 / rate
            container.mux(stream.encode(frame))
            count += 1

        yield write
        if not count:
            raise ValueError("a video needs at least one frame")
        container.mux(stream.encode())
