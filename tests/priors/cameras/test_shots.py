"""Cuts, fades and cross-fades are found in frames of two drawn walls; flashes and pans are none of them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from flowsplat.priors.cameras.shots import find_pieces, find_transitions

WIDTH, HEIGHT, FPS = 160, 96, 24.0


def wall(seed: int) -> np.ndarray:
    """[HEIGHT, 12 WIDTH] float: a wide gray image with detail of every size."""
    rng = np.random.default_rng(seed)
    image = np.zeros((HEIGHT, 12 * WIDTH))
    for sigma in (1.2, 3.0, 8.0):
        smooth = cv2.GaussianBlur(rng.normal(size=image.shape), (0, 0), sigma)
        image += smooth / smooth.std()
    return np.clip(image / image.std() * 40 + rng.uniform(90, 160), 0, 255)


def film(seed: int, speeds: Sequence[float], blur: float = 0.0) -> list[np.ndarray]:
    """A camera that moves along the wall, by so many pixels each frame, with the shutter open for a share ``blur`` of the time."""
    image, frames, x = wall(seed), [], 20.0
    for speed in speeds:
        x += speed
        open_for = np.linspace(-speed * blur / 2, speed * blur / 2, max(1, round(speed * blur)))
        frames.append(np.mean([image[:, round(x + s) : round(x + s) + WIDTH] for s in open_for], 0))
    return frames


def noisy(frames: Sequence[np.ndarray]) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [np.clip(frame + rng.normal(0, 1, frame.shape), 0, 255).astype(np.uint8) for frame in frames]


def find(frames: Sequence[np.ndarray]) -> tuple[list[str], list[tuple[int, int]], list[str]]:
    """The kinds of transitions, first and last frames of the shots, and why other pieces are left out."""
    images, seconds = noisy(frames), np.arange(len(frames)) / FPS
    transitions = find_transitions(images, seconds)
    pieces = find_pieces(images, seconds, transitions)
    shots = [(piece.first, piece.last) for piece in pieces if piece.left_out is None]
    return [each.kind for each in transitions], shots, [piece.left_out for piece in pieces if piece.left_out]


def mix(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> list[np.ndarray]:
    """A cross-fade that lasts as long as both."""
    shares = (np.arange(len(a)) + 1) / (len(a) + 1)
    return [(1 - share) * x + share * y for share, x, y in zip(shares, a, b, strict=True)]


A, B = film(1, [1] * 60), film(2, [2] * 60)


def test_one_shot_has_no_cut():
    assert find(A) == ([], [(0, 59)], [])


@pytest.mark.parametrize("at", [14, 17, 18, 19])
def test_a_cut_is_found_at_its_frame(at):
    assert find(A[:at] + B[:20]) == (["cut"], [(0, at - 1), (at, at + 19)], [])


def test_several_cuts_and_a_short_piece_that_is_left_out():
    kinds, shots, left_out = find(A[:15] + B[:6] + A[40:55])
    assert kinds == ["cut", "cut"]
    assert shots == [(0, 14), (21, 35)]
    assert left_out == ["it has fewer than 10 frames"]


def test_a_title_between_two_shots_is_left_out():
    title = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.putText(title, "PART 2", (20, 55), cv2.FONT_HERSHEY_SIMPLEX, 1.0, 255, 3)
    kinds, shots, left_out = find(A[:20] + [title.astype(float)] * 20 + B[:20])
    assert kinds == ["cut", "cut"]
    assert shots == [(0, 19), (40, 59)]
    assert left_out == ["it is a still image, as a title"]


def test_a_fade_through_black_is_left_out():
    down, up = np.linspace(0.95, 0.05, 12), np.linspace(0.05, 0.95, 12)
    dark = [share * frame for share, frame in zip(down, A[20:32], strict=True)]
    light = [share * frame for share, frame in zip(up, B[:12], strict=True)]
    kinds, shots, left_out = find(A[:20] + dark + [np.zeros((HEIGHT, WIDTH))] * 6 + light + B[12:40])
    assert kinds == ["fade"]
    assert left_out == []
    (start, end), (second, last) = shots
    assert (start, last) == (0, 77)
    assert 17 <= end <= 20  # the first frames of a fade look like those before
    assert 48 <= second <= 51


@pytest.mark.parametrize("length", [1, 4, 8, 12, 18])
def test_a_cross_fade_is_left_out(length):
    a, b = film(1, [0.5] * 60), film(2, [0.5] * 60)
    frames = a[:24] + mix(a[24 : 24 + length], b[:length]) + b[length : length + 24]
    kinds, shots, left_out = find(frames)
    assert kinds == ["cross-fade"]
    assert left_out == []
    (start, end), (second, last) = shots
    assert (start, last) == (0, len(frames) - 1)
    assert 24 - 14 <= end <= 24  # of what is mixed at most a frame with a nineteenth or more of the other shot is in it
    assert 23 + length <= second <= 24 + length + 14


def test_a_flash_is_no_cut():
    assert find(A[:20] + [np.minimum(A[20] * 2 + 40, 255)] + A[21:])[1:] == ([(0, 59)], [])
    assert find(A[:20] + [np.full((HEIGHT, WIDTH), 255.0)] * 2 + A[22:])[1:] == ([(0, 59)], [])


def test_a_flash_between_two_shots_is_left_out():
    kinds, shots, _ = find(A[:20] + [np.full((HEIGHT, WIDTH), 255.0)] * 2 + B[:20])
    assert kinds == ["fade"]
    assert shots == [(0, 19), (22, 41)]


@pytest.mark.parametrize("fastest", [8, 20, 30])
def test_a_fast_pan_is_no_cut(fastest):
    """At 30 pixels a frame all of an image is gone after five: chosen frames, one in six, share nothing."""
    ramp = np.linspace(1, fastest, 4)
    speeds = [1] * 15 + ramp.tolist() + [fastest] * 12 + ramp[::-1].tolist() + [1] * 15
    frames = film(3, speeds, blur=0.3)
    kinds, shots, left_out = find(frames)
    assert (shots, left_out) == ([(0, len(frames) - 1)], [])
    assert set(kinds) <= {"unclear"}
    assert kinds == [] or fastest > 8


def test_a_pan_in_which_nothing_can_be_followed_stays_one_shot_and_is_named():
    ramp = np.linspace(1, 110, 3)
    frames = film(3, [1] * 15 + ramp.tolist() + [110] * 6 + ramp[::-1].tolist() + [1] * 15, blur=0.5)
    kinds, shots, _ = find(frames)
    assert set(kinds) == {"unclear"}
    assert shots == [(0, len(frames) - 1)]
