"""Small inputs of every kind, made on the spot, and the folder of measured data."""

from __future__ import annotations

import os
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from av.video.reformatter import Colorspace


@pytest.fixture
def data() -> Path:
    """The folder with DAVIS clips and rig scenes."""
    root = os.environ.get("FLOWSPLAT_DATA")
    if not root:
        pytest.skip("FLOWSPLAT_DATA is not set: the data to measure with is elsewhere")
    return Path(root)


def make_image(i: int, width: int = 64, height: int = 48) -> np.ndarray:
    """RGB [H, W, 3] uint8: no two frames, and no two corners of one, are alike; smooth, so that codecs keep it."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    red, green, blue = 40 + 160 * x, 40 + 160 * y, np.full_like(x, 20 + 5 * i)
    return np.rint(np.stack([red, green, blue], -1)).astype(np.uint8)


def write_image_file(path: Path, image: np.ndarray) -> Path:
    """Write gray, RGB or RGBA by the suffix of ``path``, whatever characters it has."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.ndim == 3:
        image = image[..., [2, 1, 0, *range(3, image.shape[2])]]
    ok, encoded = cv2.imencode(path.suffix, image)
    assert ok
    encoded.tofile(path)
    return path


def write_video(
    path: Path,
    images: list[np.ndarray],
    *,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    times: list[float] | None = None,
    rate: int = 25,
    matrix: int = 1,
    full_range: bool = False,
    tags: dict[str, int] | None = None,
    options: dict[str, str] | None = None,
    prepare: Callable[[Any], None] | None = None,
    sound: bool = False,
    container_options: dict[str, str] | None = None,
) -> Path:
    """Encode RGB images.

    Args:
        times: seconds of the frames; the default is a constant ``rate``.
        matrix: H.273 number of the matrix that the images are encoded with.
        tags: what is written into the file, by the names of PyAV; the default tells the truth about matrix and range.
        prepare: called with the stream before anything is encoded.
        sound: add a track of silence.
    """
    if codec not in av.codecs_available:
        pytest.skip(f"this build of PyAV has no encoder {codec}")
    if matrix == 9 and not hasattr(Colorspace, "BT2020"):
        pytest.skip("this version of PyAV cannot encode BT.2020")
    color_range = 2 if full_range else 1
    # Two images need no order of their own and no threads, with which x265 sometimes gives packets without times.
    quiet = {"x265-params": "log-level=none:bframes=0:frame-threads=1:pools=none"} if codec == "libx265" else {}
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=rate, options={"crf": "2", **quiet, **(options or {})})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pixels
        stream.codec_context.time_base = Fraction(1, 1000 if times else rate)
        for name, value in ({"colorspace": matrix, "color_range": color_range} if tags is None else tags).items():
            setattr(stream.codec_context, name, value)
        if prepare:
            prepare(stream)
        audio = container.add_stream("aac", rate=16000, layout="mono") if sound else None
        for i, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(image), format="rgb48le" if image.dtype == np.uint16 else "rgb24"
            )
            frame = frame.reformat(
                format=pixels, dst_colorspace=5 if matrix == 6 else matrix, src_color_range=2, dst_color_range=color_range
            )
            frame.pts = i if times is None else round(times[i] * 1000)
            frame.time_base = stream.codec_context.time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
        if audio is not None:
            silence = av.AudioFrame.from_ndarray(np.zeros((1, 16000), np.float32), format="fltp", layout="mono")
            silence.sample_rate, silence.pts, silence.time_base = 16000, 0, Fraction(1, 16000)
            container.mux(audio.encode(silence))
            container.mux(audio.encode())
    return path


@pytest.fixture(name="make_image")
def make_image_fixture() -> Callable[..., np.ndarray]:
    """See ``make_image``."""
    return make_image


@pytest.fixture(name="write_image_file")
def write_image_file_fixture() -> Callable[..., Path]:
    """See ``write_image_file``."""
    return write_image_file


@pytest.fixture(name="write_video")
def write_video_fixture() -> Callable[..., Path]:
    """See ``write_video``."""
    return write_video
