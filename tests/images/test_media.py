"""Films and sounds are opened as files of this machine, whatever their names mean to FFmpeg."""

from __future__ import annotations

import os
from pathlib import Path

import av
import numpy as np
import pytest

from flowsplat.common.errors import InputError
from flowsplat.images.gif import write_gif
from flowsplat.images.media import open_media
from flowsplat.images.sound import keep_sound
from flowsplat.images.transparent import webm_writer
from flowsplat.images.video import read_first_frame, write_mp4


def a_film(path):
    write_mp4(path, [np.full((16, 16, 3), 99, np.uint8)] * 3, 8)
    return path


@pytest.mark.parametrize("name", ["12:30.mp4", "http:x.mp4", "concat:a|b.mp4", "%03d.mp4", "a b.mp4", "-.mp4", "file:x.mp4"])
def test_a_name_is_a_name(tmp_path, monkeypatch, name):
    a_film(tmp_path / "a.mp4").rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    with open_media(name) as container:
        assert len(container.streams.video) == 1


@pytest.mark.parametrize("address", ["http://127.0.0.1:9/a.mp4", "concat:a.mp4|b.mp4", "data:video/mp4,AA", "lavfi:testsrc"])
def test_addresses_are_no_files(address):
    with pytest.raises(InputError, match="does not exist"):
        open_media(address)


def test_lists_of_other_files_are_refused(tmp_path):
    film = a_film(tmp_path / "film.ts")
    (tmp_path / "list.m3u8").write_text(
        f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{film.name}\n#EXTINF:1,\nhttp://127.0.0.1:9/x.ts\n#EXT-X-ENDLIST\n"
    )
    (tmp_path / "list.txt").write_text(f"ffconcat version 1.0\nfile {film.name}\n")
    for name in ("list.m3u8", "list.txt"):
        with pytest.raises((InputError, av.FFmpegError)):
            open_media(tmp_path / name)


def test_devices_and_pipes_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.mp4")
    for path in (tmp_path / "pipe.mp4", "/dev/zero", tmp_path):
        with pytest.raises(InputError, match="not a file"):
            open_media(path)


def test_a_stretch_of_sound_is_kept(tmp_path):
    rate, tone = 16000, np.sin(np.arange(16000 * 3) / 8) * 0.4
    with av.open(str(tmp_path / "tone.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=rate)
        stream.layout = "mono"
        frame = av.AudioFrame.from_ndarray((tone * 32767).astype(np.int16)[None], format="s16", layout="mono")
        frame.sample_rate = rate
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert keep_sound(tmp_path / "tone.wav", 0.5, 1.25, tmp_path / "kept.flac")
    with av.open(str(tmp_path / "kept.flac")) as container:
        kept = np.concatenate([frame.to_ndarray().ravel() for frame in container.decode(audio=0)])
        found = container.streams.audio[0].rate
    assert abs(len(kept) / found - 1.25) < 1e-3
    again = np.interp(np.arange(len(kept)) / found + 0.5, np.arange(len(tone)) / rate, tone)
    np.testing.assert_allclose(kept[200:-200] / 32768, again[200:-200], atol=0.05)


def test_what_has_no_sound_keeps_none(tmp_path):
    assert not keep_sound(a_film(tmp_path / "a.mp4"), 0, 1, tmp_path / "kept.flac")
    (tmp_path / "text.mp4").write_text("no film")
    assert not keep_sound(tmp_path / "text.mp4", 0, 1, tmp_path / "kept.flac")
    assert not (tmp_path / "kept.flac").exists()


def test_films_of_images_that_are_too_large_are_refused(tmp_path):
    with av.open(str(tmp_path / "a.mov"), "w") as container:
        stream = container.add_stream("png", rate=5)
        stream.pix_fmt, stream.width, stream.height = "gray", 8000, 7000
        container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((7000, 8000), np.uint8), format="gray")))
        container.mux(stream.encode())
    assert (tmp_path / "a.mov").stat().st_size < 200_000
    with pytest.raises(InputError, match=r"8,000 x 7,000 pixels, more than the 55 million"):
        open_media(tmp_path / "a.mov")


@pytest.mark.parametrize("folder", ["take:2", "http:", "50% öäü"])
def test_any_folder_can_be_written_to(tmp_path, monkeypatch, folder):
    """FFmpeg takes ``take:2/a.mp4`` for an address of a protocol called take."""
    (tmp_path / folder).mkdir()
    monkeypatch.chdir(tmp_path)
    write_mp4(Path(folder, "a.mp4"), [np.zeros((16, 16, 3), np.uint8)] * 3, 5)
    write_gif(Path(folder, "a.gif"), [np.zeros((16, 16, 3), np.uint8)] * 3, 5)
    with webm_writer(Path(folder, "a.webm"), 5) as write:
        write(np.zeros((16, 16, 4), np.uint8))
    for name in ("a.mp4", "a.gif", "a.webm"):
        assert read_first_frame(Path(folder, name)).shape == (16, 16, 3)
