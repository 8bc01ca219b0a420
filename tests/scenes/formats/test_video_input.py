"""Video files of many makes come out as the images that went in."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.scenes.clip import InputOptions
from flowsplat.scenes.formats import video
from flowsplat.scenes.formats.video import display_matrix, open_video, orient

OPTIONS = InputOptions()


def read(path: Path, options: InputOptions = OPTIONS) -> list[np.ndarray]:
    clip = open_video(path, options)
    return list(clip.frames(range(clip.num_frames)))


def error(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a.astype(float) - b.astype(float)).mean())


def spend_many_bits(stream: av.VideoStream) -> None:
    stream.bit_rate = 4_000_000


def turn(angle: float, hflip: bool = False) -> Callable[[av.VideoStream], None]:
    """Write a display matrix, where this version of PyAV can."""

    def prepare(stream: av.VideoStream) -> None:
        if not hasattr(av.VideoStream, "set_display_rotation"):
            pytest.skip("this version of PyAV cannot write rotation metadata")
        stream.set_display_rotation(angle, hflip=hflip)

    return prepare


@pytest.fixture
def images(make_image) -> list[np.ndarray]:
    return [make_image(i) for i in range(12)]


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("a.mp4", "libx264"),
        ("a.mkv", "libx264"),
        ("a.ts", "libx264"),
        ("a.webm", "libvpx-vp9"),
        ("b.webm", "libvpx"),
        ("a.mp4", "libsvtav1"),
        ("a.avi", "mpeg4"),
    ],
)
def test_codecs(tmp_path, images, write_video, name, codec):
    options = (
        {"preset": "12", "svtav1-params": "lp=1"} if codec == "libsvtav1" else {"cpu-used": "8"} if codec == "libvpx-vp9" else {}
    )
    options |= {"crf": "4"} if codec == "libvpx" else {}
    path = write_video(
        tmp_path / name,
        images,
        codec=codec,
        options=options,
        matrix=5,
        prepare=spend_many_bits if codec in ("mpeg4", "libvpx") else None,
    )
    clip = open_video(path, OPTIONS)
    frames = list(clip.frames(range(clip.num_frames)))
    assert (clip.width, clip.height, clip.name, clip.num_frames) == (64, 48, path.stem, 12)
    np.testing.assert_allclose(clip.timestamps, np.arange(12) / 25, atol=2e-3)
    assert clip.source_fps == pytest.approx(25, rel=0.01)
    assert clip.notes == []
    assert clip.audio is None
    for got, sent in zip(frames, images, strict=True):
        # Blue is what tells frames apart, by five levels each.
        assert error(got, sent) < 3
        assert abs(got[..., 2].mean() - sent[..., 2].mean()) < 2


def test_without_timestamps(tmp_path, images, write_video):
    """An elementary stream has neither timestamps nor a length."""
    frames = read(write_video(tmp_path / "a.h264", images, matrix=5))
    assert len(frames) == 12
    assert all(error(got, sent) < 3 for got, sent in zip(frames, images, strict=True))


def test_some_frames(tmp_path, make_image, write_video):
    """Any rising choice of frames gives what reading all gives, also from behind key frames (seeking)."""
    sent = [make_image(i % 40) for i in range(200)]
    path = write_video(tmp_path / "a.mp4", sent, options={"g": "20"})
    everything = read(path, InputOptions(max_frames=200))
    clip = open_video(path, InputOptions(start=4.0, end=7.0))
    assert clip.num_frames == 76
    for number, frame in zip((3, 40, 75), clip.frames([3, 40, 75]), strict=True):
        np.testing.assert_array_equal(frame, everything[100 + number])
    assert list(clip.frames([])) == []


def test_what_cannot_seek_is_decoded_from_its_beginning(tmp_path, make_image, write_video, monkeypatch):
    class Unwilling:
        def __init__(self, container):
            self._container = container

        def __getattr__(self, name):
            return getattr(self._container, name)

        def seek(self, *_args, **_kwargs):
            raise av.error.PermissionError(1, "Operation not permitted")

    opened = video._open_container

    @contextlib.contextmanager
    def unwilling(path):
        with opened(path) as (container, stream):
            yield Unwilling(container), stream

    path = write_video(tmp_path / "a.mp4", [make_image(i) for i in range(60)], options={"g": "20"})
    clip = open_video(path, InputOptions(start=1.6))
    expected = list(clip.frames([0, 5]))
    monkeypatch.setattr(video, "_open_container", unwilling)
    for found, frame in zip(clip.frames([0, 5]), expected, strict=True):
        np.testing.assert_array_equal(found, frame)


def test_variable_frame_rate(tmp_path, images, write_video):
    times = np.cumsum([0.1, *([0.02, 0.09, 0.04] * 4)[:11]])
    path = write_video(tmp_path / "a.mp4", images, times=times.tolist())
    clip = open_video(path, OPTIONS)
    np.testing.assert_allclose(clip.timestamps, times - times[0], atol=1.1e-3)
    thinned = open_video(path, InputOptions(every=5))
    np.testing.assert_allclose(thinned.timestamps, (times - times[0])[[0, 5, 10]], atol=1.1e-3)
    assert all(error(got, images[i]) < 4 for got, i in zip(thinned.frames([0, 1, 2]), (0, 5, 10), strict=True))


def test_long_and_large(tmp_path, write_video):
    images = [np.full((720, 1280, 3), 40 + i, np.uint8) for i in range(60)]
    path = write_video(tmp_path / "a.mp4", images, options={"preset": "ultrafast"}, sound=True)
    clip = open_video(path, InputOptions(max_frames=8, start=0.4))
    assert (clip.width, clip.height, clip.num_frames) == (854, 480, 8)
    # 50 frames from 0.4 s on, at most 8: one in 7.
    np.testing.assert_allclose(clip.timestamps, np.arange(8) * 7 / 25, atol=1e-6)
    assert clip.source_fps == pytest.approx(25)
    notes = " ".join(clip.notes)
    assert "one frame in 7, 8 of 50" in notes
    for option in ("--start", "--every", "--max-frames", "--resize"):
        assert option in notes
    assert clip.audio == path
    assert clip.audio_start == pytest.approx(0.4)
    levels = [frame.mean() for frame in clip.frames(range(8))]
    np.testing.assert_allclose(levels, 50 + 7 * np.arange(8), atol=1.5)


def test_ten_bits(tmp_path, images, write_video):
    path = write_video(tmp_path / "a.mp4", images, codec="libx265", pixels="yuv420p10le")
    clip = open_video(path, OPTIONS)
    assert "10-bit" in " ".join(clip.notes)
    assert all(error(got, sent) < 3 for got, sent in zip(clip.frames(range(12)), images, strict=True))


@pytest.mark.parametrize("hflip", [False, True])
@pytest.mark.parametrize("angle", [0, 90, 180, -90])
def test_rotation(tmp_path, images, write_video, angle, hflip):
    path = write_video(tmp_path / "a.mp4", images, prepare=turn(angle, hflip))
    clip = open_video(path, OPTIONS)
    got = next(iter(clip.frames([0])))
    assert (clip.width, clip.height) == ((48, 64) if angle in (90, -90) else (64, 48))
    with av.open(str(path)) as container:
        data = next(container.decode(video=0)).side_data.get("DISPLAYMATRIX")
    m = np.frombuffer(data, np.int32).reshape(3, 3) / 65536 if data is not None else np.eye(3)
    # Where FFmpeg's row-vector matrix sends each corner, relative to the center.
    for x, y in itertools.product((-1, 1), (-1, 1)):
        to_x, to_y = np.rint(np.array([x, y, 0]) @ m)[:2].astype(int)
        from_pixel = images[0][-1 if y > 0 else 0, -1 if x > 0 else 0].astype(float)
        to_pixel = got[-1 if to_y > 0 else 0, -1 if to_x > 0 else 0].astype(float)
        assert np.abs(from_pixel - to_pixel).max() < 8


def test_rotation_direction(tmp_path, images, write_video):
    """A phone held upright: FFmpeg says -90 (counter-clockwise), and the image turns clockwise."""
    path = write_video(tmp_path / "a.mp4", images, prepare=turn(90))
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        turns, matrix = frame.rotation // 90, display_matrix(frame)
    assert abs(turns) == 1
    np.testing.assert_array_equal(orient(images[0], matrix), np.rot90(images[0], turns))


def test_pixel_aspect(tmp_path, images, write_video):
    def widen(stream):
        stream.codec_context.sample_aspect_ratio = Fraction(3, 2)

    clip = open_video(write_video(tmp_path / "a.mp4", images, prepare=widen), OPTIONS)
    assert (clip.width, clip.height) == (96, 48)
    assert "square" in " ".join(clip.notes)
    assert next(iter(clip.frames([0]))).shape == (48, 96, 3)


def test_first_frame_need_not_be_at_zero(tmp_path, images, write_video):
    times = (5 + np.arange(12) / 25).tolist()
    clip = open_video(write_video(tmp_path / "a.mkv", images, times=times), InputOptions(start=0.2))
    assert clip.timestamps[0] == 0
    assert clip.num_frames == 7
    assert clip.audio_start == pytest.approx(5.2)


# -- what cannot be used


def refuse(path: Path, words: str, options: InputOptions = OPTIONS) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read(path, options)
    assert "\n" not in str(caught.value)
    assert path.name in str(caught.value)


def test_empty_file(tmp_path):
    (tmp_path / "a.mp4").touch()
    refuse(tmp_path / "a.mp4", "empty")


@pytest.mark.parametrize("name", ["a.mp4", "a.txt", "a.webm", "a"])
def test_not_a_video(tmp_path, name):
    (tmp_path / name).write_text("This is a letter, and not a video.\n" * 50)
    refuse(tmp_path / name, "not a video|no video")


def test_only_sound(tmp_path):
    with av.open(str(tmp_path / "a.m4a"), "w") as container:
        stream = container.add_stream("aac", rate=16000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 16000), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 16000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    refuse(tmp_path / "a.m4a", "no video")


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.9])
@pytest.mark.parametrize(("name", "options"), [("a.mp4", {}), ("b.mp4", {"movflags": "faststart"}), ("a.mkv", {}), ("a.webm", {})])
def test_truncated(tmp_path, write_video, name, options, share):
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (48, 64, 3), np.uint8) for _ in range(50)]
    codec = "libvpx-vp9" if name.endswith("webm") else "libx264"
    codec_options = {"cpu-used": "8"} if name.endswith("webm") else {"g": "10"}
    path = write_video(tmp_path / name, noise, codec=codec, options=codec_options, container_options=options)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    refuse(path, "truncated")


def test_damaged_in_the_middle(tmp_path, write_video):
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (48, 64, 3), np.uint8) for _ in range(50)]
    path = write_video(tmp_path / "a.mp4", noise, codec="libx264", options={"g": "10"})
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 20000] = bytes(20000)
    path.write_bytes(data)
    refuse(path, r"damaged at second \d")


def test_interlaced(tmp_path, images, write_video):
    refuse(write_video(tmp_path / "a.mp4", images, options={"x264-params": "tff=1"}), "interlaced")


def test_changing_size(tmp_path, make_image, write_video):
    """Elementary streams can be chained, each with its own size."""
    first = write_video(tmp_path / "1.h264", [make_image(i) for i in range(5)])
    second = write_video(tmp_path / "2.h264", [make_image(i, 80, 64) for i in range(5)])
    path = tmp_path / "a.h264"
    path.write_bytes(first.read_bytes() + second.read_bytes())
    refuse(path, "changes its size from 64x48 to 80x64")


def test_one_frame(tmp_path, make_image, write_video):
    refuse(write_video(tmp_path / "a.mp4", [make_image(0)]), "at least two frames")


def test_two_frames(tmp_path, make_image, write_video):
    assert len(read(write_video(tmp_path / "a.mp4", [make_image(0), make_image(1)]))) == 2


def test_nothing_in_the_chosen_time(tmp_path, images, write_video):
    refuse(write_video(tmp_path / "a.mp4", images), "--start", InputOptions(start=3))


def test_too_small(tmp_path, make_image, write_video):
    refuse(write_video(tmp_path / "a.mp4", [make_image(i, 16, 16) for i in range(3)]), "too small")


def test_an_avi_with_images_that_refer_to_later_ones(tmp_path, make_image, write_video):
    sent = [make_image(i) for i in range(30)]
    path = write_video(tmp_path / "a.avi", sent, options={"bf": "2", "g": "15"}, matrix=5)
    clip = open_video(path, OPTIONS)
    frames = list(clip.frames(range(clip.num_frames)))
    assert len(frames) == 30
    assert all(abs(got[..., 2].mean() - there[..., 2].mean()) < 2 for got, there in zip(frames, sent, strict=True))
    np.testing.assert_allclose(clip.timestamps, np.arange(30) / 25, atol=2e-3)


def test_an_unknown_codec(tmp_path, images, write_video):
    path = write_video(tmp_path / "a.mp4", images)
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzzz"))
    with pytest.raises(InputError, match="cannot be decoded"):
        open_video(path, OPTIONS)
