"""Frames to an mp4 that plays everywhere: H.264, yuv420p, tagged BT.709, with the sound of the source if it has any."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import av.audio
import av.container
import av.video
import numpy as np
from llvmlite.binding import get_host_cpu_features

from flowsplat.common.errors import InputError, first_line
from flowsplat.common.files import atomic_path
from flowsplat.common.progress import report
from flowsplat.images.media import create_media, open_media

MIN_FPS, MAX_FPS = 0.1, 1000.0
"""Frames a second that can be written. Chosen by eye."""

PRESET, CRF = "veryfast", 15
"""Of x264. Half the time of its own, medium and 18, for frames that are as close to what they show (39.5 dB instead of 39.8 on one
clip), and a third more bytes."""

# https://www.itu.int/rec/T-REC-H.273: code point 1 is BT.709 for primaries, transfer and matrix. FFmpeg numbers the
# ranges 1 = limited ("MPEG") and 2 = full ("JPEG"), and its RGB matrix is 0.
_BT709 = 1
"""FFmpeg's number of the BT.709 color space."""
_LIMITED, _FULL = 1, 2
"""FFmpeg's numbers of color ranges: limited (16 to 235) and full (0 to 255)."""

# Sample rates that AAC knows and every player takes; other sources are resampled to the last one.
SOUND_RATES = (22050, 24000, 32000, 44100, 48000)
"""Samples a second that are kept as they are; other sound becomes the last of them."""
# Decoders need a few packets before the wanted sample to come up to speed after a seek.
_AUDIO_PREROLL = 0.2
"""Seconds by which sound may begin too early without being cut. Chosen by eye."""


def read_first_frame(path: Path) -> np.ndarray:
    """Return the first image of a film, [H, W, 3] RGB uint8.

    Raises:
        InputError: missing, or no film that can be read.
    """
    try:
        with open_media(path) as film:
            for frame in film.decode(video=0):
                return frame.to_ndarray(format="rgb24")
    except (av.FFmpegError, IndexError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {first_line(error)}.") from error
    raise InputError(f"{path} has no image.")


def write_mp4(path: Path, frames: Iterable[np.ndarray], fps: float, *, crf: int = 18) -> None:
    """Write RGB frames [H, W, 3] uint8 as an mp4 without sound: see ``mp4_writer``."""
    with mp4_writer(path, fps, crf=crf, preset="medium") as write:
        for frame in frames:
            write(frame)


@contextlib.contextmanager
def mp4_writer(
    path: Path,
    fps: float,
    *,
    audio_from: Path | None = None,
    audio_start: float = 0.0,
    crf: int = CRF,
    preset: str = PRESET,
) -> Iterator[Callable[[np.ndarray], None]]:
    """Yield a function that appends one RGB frame [H, W, 3] uint8; the mp4 is there, whole, when the block ends.

    An odd width or height is padded by repeating the last column or row, because yuv420p needs even sizes.

    Args:
        path: the video; its folder is made.
        fps: frames a second; near-misses of fractions such as 30000/1001 are written as that fraction.
        audio_from: a file whose sound goes with the frames, re-encoded as AAC. Without sound in it the video is silent.
        audio_start: the second of ``audio_from`` that belongs to the first frame.
        crf: x264's constant quality, lower is better and larger.
        preset: x264's, how much time it takes.

    Raises:
        InputError: the file cannot be written, or this PyAV cannot encode H.264.
        ValueError: no frames, or frames of different sizes or types.
    """
    rate = Fraction(fps).limit_denominator(1001)
    with atomic_path(path) as temporary, contextlib.ExitStack() as stack:
        container = stack.enter_context(create_media(temporary, options={"movflags": "+faststart"}))
        stream = _video_stream(container, rate, crf, preset)
        sound = stack.enter_context(_Sound(container, audio_from, audio_start))
        shape: tuple[int, ...] = ()
        count = 0

        def write(frame: np.ndarray) -> None:
            nonlocal shape, count
            if not count:
                shape = frame.shape
                stream.height, stream.width = (size + size % 2 for size in shape[:2])
            if frame.shape != shape:
                raise ValueError(f"frame {count} has shape {frame.shape}, the first one {shape}")
            container.mux(stream.encode(_video_frame(frame, count, rate)))
            count += 1
            sound.write_until(float(count / rate))

        yield write
        if not count:
            raise ValueError("a video needs at least one frame")
        container.mux(stream.encode())
        sound.finish()


def _video_stream(container: av.container.OutputContainer, rate: Fraction, crf: int, preset: str) -> av.video.VideoStream:
    options = {"crf": str(crf), "preset": preset}
    if get_host_cpu_features().get("avx512f"):
        # x264's code for AVX-512 reads what nobody has written: the same images then make other bits from process to process.
        options["x264-params"] = "asm=avx2"
    try:
        stream = container.add_stream("libx264", rate=rate, options=options)
    except (ValueError, av.FFmpegError) as error:  # UnknownCodecError is a ValueError
        raise InputError("This PyAV cannot encode H.264. Install the one from PyPI: pip install --force av.") from error
    assert isinstance(stream, av.video.VideoStream)
    stream.pix_fmt = "yuv420p"
    context = stream.codec_context
    context.time_base = 1 / rate
    context.color_range = _LIMITED
    context.colorspace = context.color_primaries = context.color_trc = _BT709
    return stream


def _video_frame(image: np.ndarray, index: int, rate: Fraction) -> av.VideoFrame:
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"a frame must be [H, W, 3] uint8, not {image.shape} {image.dtype}")
    odd_rows, odd_columns = image.shape[0] % 2, image.shape[1] % 2
    image = np.pad(image, ((0, odd_rows), (0, odd_columns), (0, 0)), mode="edge")
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
    frame = frame.reformat(format="yuv420p", src_color_range=_FULL, dst_color_range=_LIMITED, dst_colorspace=_BT709)
    frame.color_range, frame.colorspace = _LIMITED, _BT709
    frame.pts, frame.time_base = index, 1 / rate
    return frame


class _Sound:
    """The audio track of a video that is being written; does nothing if there is no sound to write."""

    def __init__(self, container: av.container.OutputContainer, path: Path | None, start: float):
        self._container = container
        self._source = contextlib.ExitStack()
        self._stream: av.audio.AudioStream | None = None
        self._written = 0
        if path is None:
            return
        try:
            source = self._source.enter_context(open_media(path))
        except (InputError, av.FFmpegError) as error:
            report(f"The sound of {path} cannot be read ({error}): the video stays silent.")
            return
        audio = find_sound_track(source)
        if audio is None:
            report(f"The sound of {path} cannot be decoded: the video stays silent.")
        else:
            rate = audio.rate if audio.rate in SOUND_RATES else SOUND_RATES[-1]
            self._stream = container.add_stream("aac", rate=rate)
            self._stream.layout = "mono" if audio.channels == 1 else "stereo"
            self._pending = np.zeros((self._stream.channels, 0), np.float32)
            self._blocks = read_sound_blocks(source, audio, start, rate, self._stream.layout.name)

    def write_until(self, seconds: float) -> None:
        """Encode the sound up to that second, so that it lies next to its images in the file."""
        if self._stream is None:
            return
        wanted = round(seconds * self._stream.rate) - self._written
        while self._pending.shape[1] < wanted and (block := next(self._blocks, None)) is not None:
            self._pending = np.concatenate([self._pending, block], axis=1)
        now, self._pending = self._pending[:, :wanted], self._pending[:, wanted:]
        if now.shape[1]:
            frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(now), "fltp", self._stream.layout.name)
            frame.sample_rate = self._stream.rate
            frame.pts, frame.time_base = self._written, Fraction(1, self._stream.rate)
            self._container.mux(self._stream.encode(frame))
            self._written += now.shape[1]

    def finish(self) -> None:
        """Write what the encoder still holds."""
        if self._stream is not None:
            self._container.mux(self._stream.encode())

    def __enter__(self) -> _Sound:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._source.close()


def find_sound_track(container: av.container.InputContainer) -> av.audio.AudioStream | None:
    """Return the first track of sound that can be decoded: FFmpeg lists others, too."""
    return next((track for track in container.streams.audio if track.codec_context is not None), None)


def read_sound_blocks(
    container: av.container.InputContainer, audio: av.audio.AudioStream, start: float, rate: int, layout: str
) -> Iterator[np.ndarray]:
    """Blocks [channels, samples] float32 at ``rate``, the first sample the one at ``start`` seconds of the file."""
    if start > _AUDIO_PREROLL and audio.time_base:
        container.seek(int((start - _AUDIO_PREROLL) / audio.time_base), stream=audio)
    resampler = av.AudioResampler("fltp", layout, rate)
    surplus: int | None = None  # samples that come before the first wanted one
    with contextlib.suppress(av.FFmpegError):  # damaged sound ends early and costs no images
        for decoded in container.decode(audio):
            if surplus is None:
                surplus = round((start - (decoded.time or 0.0)) * rate)
                yield np.zeros((1 if layout == "mono" else 2, max(-surplus, 0)), np.float32)
            for frame in resampler.resample(decoded):
                block = frame.to_ndarray()
                yield block[:, max(surplus, 0) :]
                surplus = max(surplus - block.shape[1], 0)
