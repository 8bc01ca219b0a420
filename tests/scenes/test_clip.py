"""Which frames are chosen, at which size, and what the user is told about it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowsplat.common.errors import InputError
from flowsplat.scenes.clip import InputOptions, choose_working_size, resize_image, resize_labels, select_frames


def test_everything_by_default():
    chosen = select_frames(3 + np.arange(50) / 25, InputOptions(), "clip")
    np.testing.assert_array_equal(chosen.numbers, np.arange(50))
    np.testing.assert_allclose(chosen.timestamps, np.arange(50) / 25)
    assert chosen.start == 3
    assert chosen.notes == []


def test_long_clip_is_thinned_to_its_end():
    """60 seconds at 30 frames a second."""
    chosen = select_frames(np.arange(1800) / 30, InputOptions(), "clip")
    np.testing.assert_array_equal(chosen.numbers, np.arange(0, 1800, 18))
    notes = " ".join(chosen.notes)
    assert "one frame in 18, 100 of 1800" in notes
    assert "--every" in notes
    assert "--max-frames" in notes
    assert "0.6 seconds apart" in notes


def test_chosen_rate_is_kept_and_the_end_cut():
    chosen = select_frames(np.arange(1800) / 30, InputOptions(every=2), "clip")
    np.testing.assert_array_equal(chosen.numbers, np.arange(0, 200, 2))
    assert "Cut off the last 53.4 seconds" in " ".join(chosen.notes)


def test_times():
    options = InputOptions(start=1.0, end=2.0)
    chosen = select_frames(7 + np.arange(100) / 25, options, "clip")
    assert (chosen.numbers[0], chosen.numbers[-1]) == (25, 50)
    assert chosen.timestamps[0] == 0
    assert chosen.start == pytest.approx(8)
    assert "--start" in chosen.notes[0]


@given(
    count=st.integers(2, 500),
    every=st.none() | st.integers(1, 20),
    max_frames=st.integers(2, 200),
    start=st.none() | st.floats(0, 10),
)
def check_laws(count, every, max_frames, start):
    seconds = np.arange(count) / 30
    options = InputOptions(every=every, max_frames=max_frames, start=start)
    try:
        chosen = select_frames(seconds, options, "clip")
    except InputError:
        assert (seconds >= (start or 0) - 1e-3).sum() <= (every or 1) or count < 2
        return
    assert 2 <= len(chosen.numbers) <= max_frames
    assert len(set(np.diff(chosen.numbers))) == 1
    assert chosen.timestamps[0] == 0
    assert seconds[chosen.numbers[0]] >= (start or 0) - 1e-3
    # Something is said exactly when something was dropped.
    assert (len(chosen.numbers) < count) == bool(chosen.notes)


@pytest.mark.parametrize(
    ("count", "options", "words"),
    [
        (0, {}, "has 0 frame"),
        (1, {}, "at least two frames"),
        (30, {"start": 5.0}, "0 of 30 frames over 0.967 seconds"),
        (30, {"every": 30}, "1 of 30"),
    ],
)
def test_too_few(count, options, words):
    with pytest.raises(InputError, match=words):
        select_frames(np.arange(count) / 30, InputOptions(**options), "clip")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("start", -1.0),
        ("start", float("nan")),
        ("end", 0.0),
        ("end", float("inf")),
        ("every", 0),
        ("max_frames", 1),
        ("resize", -1),
        ("resize", 5),
        ("holdout", 0),
        ("holdout", 1),
        ("fps", 0.0),
        ("fps", float("nan")),
        ("fps", 1e-5),
        ("fps", 1e6),
        ("max_frames", 10**9),
        ("resize", 10**6),
        ("every", 10**12),
    ],
)
def test_senseless_options(name, value):
    with pytest.raises(InputError, match=f"--{name.replace('_', '-')} "):
        InputOptions(**{name: value}).check()


def test_sensible_options():
    InputOptions().check()
    InputOptions(start=1, end=2, every=1, max_frames=2, resize=0, holdout=None, fps=0.5).check()


@pytest.mark.parametrize(
    ("size", "resize", "expected"),
    [
        ((854, 480), None, (854, 480)),
        ((1920, 1080), None, (854, 480)),
        ((1080, 1920), None, (480, 854)),
        ((640, 360), None, (640, 360)),
        ((1920, 1080), 0, (1920, 1080)),
        ((1920, 1080), 427, (427, 240)),
        ((320, 240), 640, (320, 240)),
    ],
)
def test_working_size(size, resize, expected):
    got, notes = choose_working_size(*size, InputOptions(resize=resize), "clip")
    assert got == expected
    assert bool(notes) == (expected != size)


def test_too_small():
    with pytest.raises(InputError, match="too small"):
        choose_working_size(4000, 100, InputOptions(), "clip")


def test_resizing_keeps_the_pixel_grid():
    """A ramp over x + 0.5 is the same ramp at any size; labels stay labels."""
    ramp = np.repeat((np.arange(96) + 0.5)[None], 64, 0).astype(np.float32)
    np.testing.assert_allclose(resize_image(ramp, (48, 32))[0] / 96, (np.arange(48) + 0.5) / 48, atol=1e-5)
    np.testing.assert_allclose(resize_image(ramp, (192, 128))[0, 4:-4] / 96, ((np.arange(192) + 0.5) / 192)[4:-4], atol=1e-3)
    labels = np.random.default_rng(0).integers(0, 9, (64, 96)).astype(np.uint8)
    assert set(np.unique(resize_labels(labels, (31, 17)))) <= set(range(9))
    np.testing.assert_array_equal(resize_labels(labels, (32, 64))[:, 0], labels[:, 1])
