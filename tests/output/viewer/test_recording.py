"""Names of what a client takes away."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowsplat.geometry import Camera
from flowsplat.output.viewer.recording import RATES, SIZES, Recording, next_file


def test_no_two_recordings_get_one_name(tmp_path):
    (tmp_path / "recording_001.mp4").touch()
    names = [next_file(tmp_path, "recording", suffix).name for suffix in (".mp4", ".mp4", ".gif")]
    assert names == ["recording_002.mp4", "recording_003.mp4", "recording_001.gif"]


def camera(width: int, height: int) -> Camera:
    return Camera(np.eye(4), np.array([[50.0, 0, width / 2], [0, 50, height / 2], [0, 0, 1]]), width, height)


@pytest.mark.parametrize(
    ("of", "size", "becomes"),
    [
        ((854, 480), "as the path", (854, 480)), ((854, 480), "1080p", (1922, 1080)), ((480, 854), "720p", (720, 1280)),
        ((64, 64), "480p", (480, 480)),
    ],
)  # fmt: skip
def test_the_size_keeps_the_shape(of, size, becomes):
    resized = Recording(Path("a.mp4"), size).resize(camera(*of))
    assert (resized.width, resized.height) == becomes
    assert np.allclose(resized.K[:2, 2], np.divide(becomes, 2))


@pytest.mark.parametrize(
    ("name", "rate", "fps"),
    [
        ("a.mp4", "as the clip", 29.97), ("a.mp4", "60", 60.0), ("a.webm", "12.5", 12.5), ("a.gif", "as the clip", 12.5),
        ("a.gif", "25", 25.0), ("a.gif", "60", 50.0), ("a.gif", "24", 25.0),
    ],
)  # fmt: skip
def test_the_rate_is_one_that_the_file_can_say(name, rate, fps):
    assert Recording(Path(name), rate=rate).choose_fps(29.97) == pytest.approx(fps)


def test_every_choice_can_be_made():
    for size in SIZES:
        for rate in RATES:
            recording = Recording(Path("a.mp4"), size, rate)
            assert recording.choose_fps(24.0) > 0
            assert recording.resize(camera(64, 48)).height >= 48
