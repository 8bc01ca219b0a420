"""mp4 writing: what comes back out of the file is what went in."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.images.video import mp4_writer, write_mp4

COLORS = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255), (0, 0, 0), (200, 120, 40)]

# Said explicitly, because older PyAV do not read the tags of a file: BT.709, limited range in, full range out.
AS_TAGGED = {"src_colorspace": 1, "src_color_range": 1, "dst_color_range": 2}


def plain_frames(count: int = 6, height: int = 48, width: int = 64) -> list[np.ndarray]:
    return [np.full((height, width, 3), COLORS[k % len(COLORS)], np.uint8) for k in range(count)]


def decode(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    return [frame.reformat(format="rgb24", **AS_TAGGED).to_ndarray() for frame in frames]


def write_tone(path: Path, seconds: float, channels: str = "stereo", rate: int = 44100) -> None:
    """Silence up to one second, then a loud 440 Hz tone."""
    time = np.arange(int(seconds * rate)) / rate
    tone = (0.5 * np.sin(2 * np.pi * 440 * time) * (time >= 1) * 32767).astype(np.int16)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=rate)
        stream.layout = channels
        samples = np.repeat(tone, 2 if channels == "stereo" else 1)[None]
        frame = av.AudioFrame.from_ndarray(samples, format="s16", layout=channels)
        frame.sample_rate, frame.pts, frame.time_base = rate, 0, Fraction(1, rate)
        container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_with_sound(path: Path, count: int, source: Path, start: float = 0.0) -> None:
    with mp4_writer(path, 24, audio_from=source, audio_start=start) as write:
        for frame in plain_frames(count):
            write(frame)


def read_sound(path: Path) -> tuple[np.ndarray, int]:
    with av.open(str(path)) as container:
        frames = list(container.decode(audio=0))
        first = frames[0]
        samples = np.concatenate([frame.to_ndarray() for frame in frames], axis=1)
        # The encoder's run-in has a negative time and is not played.
        return samples[:, max(round(-(first.time or 0.0) * first.sample_rate), 0) :], first.sample_rate


def test_round_trip_keeps_size_count_rate_and_colors(tmp_path):
    frames = plain_frames()
    write_mp4(tmp_path / "new folder" / "clip.mp4", iter(frames), 24)
    decoded = decode(tmp_path / "new folder" / "clip.mp4")
    assert len(decoded) == len(frames)
    for frame, back in zip(frames, decoded, strict=True):
        assert back.shape == frame.shape
        assert np.abs(back.astype(int) - frame).max() <= 4
    assert [p.name for p in (tmp_path / "new folder").iterdir()] == ["clip.mp4"]


def test_an_image_survives(tmp_path):
    y, x = np.mgrid[:90, :160] / 100
    image = (np.stack([np.sin(3 * x) ** 2, np.cos(2 * y) ** 2, 0.4 + 0.3 * np.sin(x + y)], -1) * 255).astype(np.uint8)
    write_mp4(tmp_path / "a.mp4", [image] * 3, 10)
    error = decode(tmp_path / "a.mp4")[1].astype(float) - image
    assert np.abs(error).mean() < 2
    assert np.abs(error.mean((0, 1))).max() < 2, "a color cast: the matrix and its tag disagree"


@pytest.mark.parametrize(("fps", "expected"), [(24, 24), (29.97002997, Fraction(30000, 1001)), (12.5, Fraction(25, 2))])
def test_tags_and_rate(tmp_path, fps, expected):
    write_mp4(tmp_path / "a.mp4", plain_frames(12), fps)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
        assert (context.color_range, context.colorspace, context.color_primaries, context.color_trc) == (1, 1, 1, 1)
        assert stream.average_rate == expected
        assert not container.streams.audio
        assert float(container.duration / av.time_base) == pytest.approx(12 / fps, abs=2e-3)
    data = (tmp_path / "a.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "a browser must know the video before it has all of it"


def test_odd_sizes_are_padded(tmp_path):
    frame = np.zeros((33, 47, 3), np.uint8)
    frame[:, 24:] = 255
    write_mp4(tmp_path / "a.mp4", [frame] * 2, 24)
    back = decode(tmp_path / "a.mp4")[0]
    assert back.shape == (34, 48, 3)
    assert back[:, -1].min() > 240


@pytest.mark.parametrize("layout", ["mono", "stereo"])
def test_sound_is_cut_to_the_clip(tmp_path, layout):
    write_tone(tmp_path / "tone.wav", 3, layout)
    write_with_sound(tmp_path / "a.mp4", 24, tmp_path / "tone.wav", 0.5)
    samples, rate = read_sound(tmp_path / "a.mp4")
    assert samples.shape[0] == (1 if layout == "mono" else 2)
    assert samples.shape[1] / rate == pytest.approx(1.0, abs=0.06)
    loud = np.abs(samples[0]) > 0.2
    assert np.argmax(loud) / rate == pytest.approx(0.5, abs=0.03), "the tone starts at 1 s of the source"


def test_sound_of_an_unusual_rate_that_is_shorter_than_the_clip(tmp_path):
    write_tone(tmp_path / "tone.wav", 1.5, rate=11025)
    write_with_sound(tmp_path / "a.mp4", 48, tmp_path / "tone.wav")
    samples, rate = read_sound(tmp_path / "a.mp4")
    assert rate == 48000
    assert np.argmax(np.abs(samples[0]) > 0.2) / rate == pytest.approx(1.0, abs=0.03)
    assert len(decode(tmp_path / "a.mp4")) == 48


@pytest.mark.parametrize("kind", ["silent", "missing", "not a video"])
def test_without_sound_the_video_is_silent(tmp_path, kind):
    source = tmp_path / "source.mp4"
    if kind == "silent":
        write_mp4(source, plain_frames(), 24)
    elif kind == "not a video":
        source.write_text("no video at all")
    write_with_sound(tmp_path / "a.mp4", 6, source)
    assert len(decode(tmp_path / "a.mp4")) == 6


def test_a_failure_leaves_the_old_video(tmp_path):
    write_mp4(tmp_path / "a.mp4", plain_frames(3), 24)

    def broken():
        yield from plain_frames(4)
        raise RuntimeError("rendering failed")

    with pytest.raises(RuntimeError):
        write_mp4(tmp_path / "a.mp4", broken(), 24)
    assert len(decode(tmp_path / "a.mp4")) == 3
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_misuse_is_refused(tmp_path):
    with pytest.raises(ValueError, match="at least one frame"):
        write_mp4(tmp_path / "a.mp4", [], 24)
    with pytest.raises(ValueError, match="frame 1"):
        write_mp4(tmp_path / "a.mp4", [np.zeros((8, 8, 3), np.uint8), np.zeros((8, 10, 3), np.uint8)], 24)
    with pytest.raises(ValueError, match="uint8"):
        write_mp4(tmp_path / "a.mp4", [np.zeros((8, 8, 3))], 24)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError):
        write_mp4(tmp_path / "file" / "a.mp4", plain_frames(), 24)


def test_sound_that_cannot_be_decoded_is_left_out(tmp_path, capsys):
    write_tone(tmp_path / "tone.mov", 1.0)
    # Big-endian or little-endian samples of a kind that nobody knows.
    (tmp_path / "tone.mov").write_bytes((tmp_path / "tone.mov").read_bytes().replace(b"sowt", b"zzzz"))
    write_with_sound(tmp_path / "a.mp4", 12, tmp_path / "tone.mov")
    assert "cannot be decoded: the video stays silent" in capsys.readouterr().err
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert not container.streams.audio


ENCODE = """
import hashlib, sys
from pathlib import Path
import numpy as np
from flowsplat.images.gif import write_gif
from flowsplat.images.transparent import webm_writer
from flowsplat.images.video import mp4_writer
folder = Path(sys.argv[1])
rng = np.random.default_rng(0)
used = [rng.integers(0, 255, int(rng.integers(1, 9_000_000)), dtype=np.uint8) for _ in range(40)]  # memory that was something else
del used
sound = folder.parent / "sound.flac"
for width, height in ((427, 241), (864, 480), (1281, 241)):
    noise = np.kron(rng.integers(0, 255, (height // 8 + 9, width // 8 + 9, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    frames = [noise[k : k + height, 2 * k : 2 * k + width] for k in range(12)]
    with mp4_writer(folder / f"{width}.mp4", 24.0, audio_from=sound) as write:
        for frame in frames:
            write(frame)
with webm_writer(folder / "a.webm", 24.0) as write:
    for frame in frames[:4]:
        write(np.concatenate([frame, frame[..., :1]], -1))
write_gif(folder / "a.gif", frames[:4], 12.5)
for path in sorted(folder.iterdir()):
    print(path.name, hashlib.sha256(path.read_bytes()).hexdigest())
"""


@pytest.mark.slow
def test_the_same_images_make_the_same_file_in_every_process(tmp_path):
    tone = (np.sin(np.arange(16000) / 8) * 9000).astype(np.int16)
    with av.open(str(tmp_path / "sound.flac"), "w") as container:
        stream = container.add_stream("flac", rate=16000)
        stream.layout, stream.format = "mono", "s16"
        frame = av.AudioFrame.from_ndarray(tone[None], "s16", "mono")
        frame.sample_rate = 16000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    found = set()
    for number in range(6):
        folder = tmp_path / str(number)
        folder.mkdir()
        done = subprocess.run([sys.executable, "-c", ENCODE, str(folder)], capture_output=True, text=True, check=True, timeout=200)
        found.add(done.stdout)
    assert len(found) == 1, found
