"""Video files, by FFmpeg (PyAV): any codec, variable frame rate, rotation, pixel aspect, 10 bits and high dynamic range."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream

from flowsplat.common.errors import InputError
from flowsplat.images.media import open_media
from flowsplat.scenes.clip import Clip, InputOptions, choose_working_size, resize_image, select_frames
from flowsplat.scenes.formats.video_color import VideoColors, colors_of, decode_rgb, to_srgb
from flowsplat.scenes.repeats import look_size

VIDEO_SUFFIXES = (
    ".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp", ".ogv", ".wmv", ".flv", ".gif",
)  # fmt: skip
"""Files of a folder that are taken for clips; a clip that is given by its own name may be called anything."""
SEEK_MARGIN = 2.0
"""Seconds before the first wanted frame to which decoding jumps. Chosen by eye."""

_SHRINKING = 0x20 | 0x40000 | 0x80000
"""swscale's flags AREA | ACCURATE_RND | BITEXACT, as in ``video_color``."""
TEXT_CODECS = {"ansi", "bintext", "idf", "xbin"}
"""FFmpeg plays text files as images of their letters."""
PACKET_CODECS = {"h264", "hevc", "vvc", "vp9", "av1", "libdav1d", "mjpeg", "prores", "dnxhd"}
"""Codecs of which every packet is one frame; others (VP8, DivX) also have packets of images that are never shown."""


COUNTED_FORMATS = {"avi"}
"""Formats without timestamps: FFmpeg numbers their packets, which lie in another order than the images where some refer to later
ones."""


@contextlib.contextmanager
def _open_container(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """The container and its main video stream; whatever FFmpeg refuses meanwhile becomes an ``InputError``."""
    try:
        with open_media(path) as container:
            stream = container.streams.best("video")
            if isinstance(stream, VideoStream) and stream.codec_context is None:
                raise InputError(f"{path} has a video of a kind that cannot be decoded: convert it to H.264 first.")
            if not isinstance(stream, VideoStream) or stream.codec_context.name in TEXT_CODECS:
                raise InputError(f"{path} holds no video.")
            stream.thread_type = "AUTO"
            yield container, stream
    except av.FFmpegError as error:
        if path.stat().st_size == 0:
            raise InputError(f"{path} is empty.") from error
        raise InputError(f"{path} is not a video file, or it is truncated or damaged ({error.strerror}).") from error


@dataclass(frozen=True)
class _Index:
    """Which frames a video has.

    Attributes:
        keys: [N] rising presentation timestamps in ticks, or just 0, 1, 2, ... where the file has none.
        seconds: [N] the same in seconds.
        has_timestamps: which of both.
        fps: mean frames a second.
    """

    keys: np.ndarray
    seconds: np.ndarray
    has_timestamps: bool
    fps: float


def _read_index(path: Path) -> _Index:
    """Go through the packets of the file; decode them only where some may hold no image.

    Raises:
        InputError: the file ends early.
    """
    keys: list[int | None] = []
    end, damaged = 0.0, False
    with _open_container(path) as (container, stream):
        for packet in _packets(container):
            is_image = packet is not None and packet.stream.index == stream.index and packet.size > 0
            if packet is None or (is_image and packet.is_corrupt):
                damaged = True
                break
            if packet.pts is not None and packet.time_base is not None:
                end = max(end, float((packet.pts + (packet.duration or 0)) * packet.time_base))
            if is_image and not packet.is_discard:
                keys.append(packet.pts)
        start, duration = (container.start_time or 0) / av.time_base, (container.duration or 0) / av.time_base
        # Some formats count the duration from zero, others from the first frame.
        if damaged or duration - (end - min(start, 0)) > max(0.1, 0.05 * duration):
            raise InputError(
                f"{path} is truncated or damaged: only about {len(keys)} frames, up to second {end - start:.1f} of {duration:.1f}, "
                "can be read. Copy or download it again."
            )
        rate = float(stream.average_rate or stream.guessed_rate or 0) or 25.0
        tick = float(stream.time_base or 1)
        each_packet_is_a_frame = stream.codec_context.name in PACKET_CODECS
        has_timestamps = container.format.name not in COUNTED_FORMATS
    if not each_packet_is_a_frame:
        with _open_container(path) as (container, stream):
            keys = [frame.pts for frame in container.decode(stream)]
    known = {key for key in keys if key is not None}
    if len(known) < len(keys) or not has_timestamps:
        return _Index(np.arange(len(keys)), np.arange(len(keys)) / rate, False, rate)
    ordered = np.array(sorted(known), np.int64)
    fps = (len(ordered) - 1) / ((ordered[-1] - ordered[0]) * tick) if len(ordered) > 1 else rate
    return _Index(ordered, ordered * tick, True, float(fps))


def _packets(container: InputContainer) -> Iterator[av.Packet | None]:
    """Yield the packets of all streams; a last None where reading failed."""
    try:
        yield from container.demux()
    except av.FFmpegError:
        yield None


def _check_frame(frame: av.VideoFrame, path: Path) -> None:
    if frame.interlaced_frame:
        raise InputError(
            f"{path} is interlaced: each image mixes two times. Deinterlace it first, "
            f"for example with ffmpeg -i IN -vf bwdif OUT.mp4."
        )


def display_matrix(frame: av.VideoFrame) -> np.ndarray:
    """Return [2, 2] integer: where the image's right and down point to on the screen; the identity without rotation metadata.

    Rows are (x, y) on the screen, columns (x, y) in the image. Oblique angles become the nearest right one.
    """
    data: Any = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return np.eye(2, dtype=int)
    # FFmpeg's libavutil/display.h: x' = m[0] x + m[3] y, y' = m[1] x + m[4] y, in 16.16 fixed point.
    m = np.frombuffer(data, np.int32)
    matrix = np.array([[m[0], m[3]], [m[1], m[4]]], np.float64)
    upright = abs(matrix[0, 0]) + abs(matrix[1, 1]) >= abs(matrix[0, 1]) + abs(matrix[1, 0])
    kept = np.eye(2) if upright else np.eye(2)[::-1]
    return (np.where(matrix < 0, -1, 1) * kept).astype(int)


def orient(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Turn and mirror an image [H, W, 3] as ``display_matrix`` says."""
    if matrix[0, 1]:
        image = image.swapaxes(0, 1)
    flip_x, flip_y = matrix[0].sum() < 0, matrix[1].sum() < 0
    return np.ascontiguousarray(image[:: -1 if flip_y else 1, :: -1 if flip_x else 1])


def _decode(path: Path, index: _Index, first: int) -> Iterator[tuple[int, av.VideoFrame]]:
    """Decoded frames with their keys, from ``first`` or earlier on."""
    if index.has_timestamps and first > index.keys[0]:
        with _open_container(path) as (container, stream), contextlib.suppress(av.FFmpegError):
            margin = int(SEEK_MARGIN / float(stream.time_base or 1))
            container.seek(max(first - margin, int(index.keys[0])), stream=stream, backward=True)
            frames = ((int(frame.pts), frame) for frame in container.decode(stream) if frame.pts is not None)
            start = next(frames, None)
            if start is not None and start[0] <= first:
                yield start
                yield from frames
                return
    # Some containers cannot seek, or land too late: then everything is decoded.
    with _open_container(path) as (container, stream), contextlib.suppress(av.FFmpegError):
        for count, frame in enumerate(container.decode(stream)):
            yield (int(frame.pts or 0) if index.has_timestamps else count), frame


def _look(path: Path, index: _Index, numbers: np.ndarray, size: tuple[int, int]) -> Iterator[np.ndarray | None]:
    """Yield small gray images of the frames ``numbers``, up to one that cannot be decoded: ``VideoClip.frames`` tells of it."""
    wanted = index.keys[numbers]
    found = 0
    for key, frame in _decode(path, index, int(wanted[0])):
        while found < len(wanted) and wanted[found] < key:
            yield None
            found += 1
        if found == len(wanted):
            return
        if key == wanted[found]:
            yield frame.reformat(*size, format="gray", interpolation=_SHRINKING).to_ndarray()
            found += 1


@dataclass(kw_only=True)
class VideoClip(Clip):
    """Chosen frames of a video file.

    Attributes:
        path: the file.
        index: all its frames.
        numbers: [T] which of them were chosen.
        coded_size: (width, height) in pixels as stored.
        colors: how colors are stored.
        matrix: how images are turned, see ``display_matrix``.
    """

    path: Path
    index: _Index
    numbers: np.ndarray
    coded_size: tuple[int, int]
    colors: VideoColors
    matrix: np.ndarray

    def frames(self, numbers: Sequence[int]) -> Iterator[np.ndarray]:
        wanted = [int(self.index.keys[self.numbers[i]]) for i in numbers]
        if not wanted:
            return
        found = 0
        for key, frame in _decode(self.path, self.index, wanted[0]):
            if key < wanted[found]:
                continue
            if key > wanted[found] or frame.is_corrupt:
                break
            yield self._image(frame)
            found += 1
            if found == len(wanted):
                return
        second = self.timestamps[numbers[found]] + self.index.seconds[self.numbers[0]] - self.index.seconds[0]
        raise InputError(
            f"{self.path} is damaged at second {second:.2f}: only {numbers[found]} of {self.num_frames} frames can be read. "
            "Copy it again, or leave the damage out with --start and --end."
        )

    def look(self) -> Iterator[np.ndarray | None]:
        # Gray as it is stored, and small at once: no colors are converted.
        for image in _look(self.path, self.index, self.numbers, look_size(*self.coded_size)):
            yield None if image is None else orient(image, self.matrix)

    def _image(self, frame: av.VideoFrame) -> np.ndarray:
        _check_frame(frame, self.path)
        if (frame.width, frame.height) != self.coded_size:
            raise InputError(
                f"{self.path} changes its size from {self.coded_size[0]}x{self.coded_size[1]} to "
                f"{frame.width}x{frame.height} pixels. Choose a piece of one size with --start and --end."
            )
        size = (self.height, self.width) if self.matrix[0, 1] else (self.width, self.height)
        codes = resize_image(decode_rgb(frame, self.colors), size)
        return orient(to_srgb(codes, self.colors), self.matrix)


def open_video(path: Path, options: InputOptions) -> VideoClip:
    """Open a video file and choose its frames.

    Raises:
        InputError: not a video, empty, truncated, interlaced, or with fewer than two frames to use.
    """
    path = Path(path)
    index = _read_index(path)
    with _open_container(path) as (container, stream):
        first = next(container.decode(stream), None)
        if first is None:
            raise InputError(f"{path} holds no frame that can be decoded: it is damaged.")
        has_audio = bool(container.streams.audio)
        aspect = float(stream.sample_aspect_ratio or 1)
    if index.has_timestamps and first.pts is not None:
        # Images that refer to a key frame before the beginning are in the file but cannot be decoded.
        shown = index.keys >= first.pts
        index = _Index(index.keys[shown], index.seconds[shown], True, index.fps)
    _check_frame(first, path)
    colors = colors_of(first, str(path))
    size = look_size(first.width, first.height)
    selection = select_frames(index.seconds, options, str(path), lambda numbers: _look(path, index, numbers, size))
    matrix = display_matrix(first)
    notes = list(selection.notes)
    shown_size = (max(1, round(first.width * aspect)), first.height)
    if shown_size[0] != first.width:
        notes.append(f"Pixels that are {aspect:.3g} times as wide as high were made square.")
    if matrix[0, 1]:
        shown_size = shown_size[::-1]
    (width, height), resize_notes = choose_working_size(*shown_size, options, str(path))
    return VideoClip(
        name=path.stem,
        source=str(path),
        width=width,
        height=height,
        timestamps=selection.timestamps,
        source_fps=index.fps,
        notes=notes + resize_notes + colors.notes,
        audio=path if has_audio else None,
        audio_start=selection.start,
        begin=selection.begin,
        available=selection.available,
        path=path,
        index=index,
        numbers=selection.numbers,
        coded_size=(first.width, first.height),
        colors=colors,
        matrix=matrix,
    )
