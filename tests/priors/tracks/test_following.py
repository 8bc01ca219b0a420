"""A point goes unseen while something is before it, and is found again."""

from __future__ import annotations

import numpy as np

from flowsplat.priors.tracks.following import MAX_GAP, Follower
from flowsplat.scenes import Flow

from .textures import shifted, texture

SIZE = (90, 140)
VELOCITY = np.array([2.0, 0.5])
WORLD, COVER = texture(150, 260), texture(150, 260, seed=3, blobs=0.7) // 3


def image(i: int, hidden: bool = False) -> np.ndarray:
    """A texture that moves; something else before columns 40 to 60 of frames 8 to 10."""
    image = shifted(WORLD, 2.0 * i, 0.5 * i, SIZE[1], SIZE[0])
    if hidden and 8 <= i <= 10:
        image[:, 40:60] = COVER[: SIZE[0], 40:60]
    return image


def follow(hidden: bool = False, frames: int = 16) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [P, T, 2], where they truly are, and where they were seen [P, T]."""
    y, x = np.mgrid[12:72:6, 12:72:6]
    start = np.stack([x.ravel(), y.ravel()], -1) + 0.5
    labels, sure = np.zeros(SIZE, np.int32), np.ones(SIZE, np.float32)
    flow = Flow(0, 1, np.broadcast_to(np.float32(VELOCITY), (*SIZE, 2)).copy(), sure)
    follower = Follower()
    follower.add(np.arange(len(start)), start, image(0), labels)
    points, seen = np.full((len(start), frames, 2), np.nan), np.zeros((len(start), frames), bool)
    for i in range(frames):
        if i:
            follower.step(image(i, hidden), labels, flow)
        points[follower.ids, i], seen[follower.ids, i] = follower.points, follower.seen
    return points, start[:, None] + np.arange(frames)[:, None] * VELOCITY, seen


def test_in_the_open_all_points_live():
    points, true, seen = follow()
    assert seen.mean() > 0.97
    assert np.median(np.linalg.norm(points - true, axis=-1)[seen]) < 0.1


def test_a_short_occlusion_is_survived_unseen():
    points, true, seen = follow(hidden=True)
    behind = ((true[:, 8:11, 0] > 43) & (true[:, 8:11, 0] < 57)).all(1)
    assert behind.sum() > 8
    assert seen[behind, 8:11].mean() < 0.2
    assert seen[behind, 12:].mean() > 0.8
    assert np.median(np.linalg.norm(points - true, axis=-1)[behind, 12:][seen[behind, 12:]]) < 0.3


def test_what_never_comes_back_is_given_up():
    labels, sure = np.zeros(SIZE, np.int32), np.ones(SIZE, np.float32)
    flow = Flow(0, 1, np.zeros((*SIZE, 2), np.float32), sure)
    follower = Follower()
    follower.add(np.array([7]), np.array([[50.5, 40.5]]), image(0), labels)
    follower.step(COVER[: SIZE[0], : SIZE[1]], labels, flow)
    assert len(follower.ids) == 0  # no velocity yet, and no neighbor to follow
    y, x = np.mgrid[20:60:8, 20:80:8]
    start = np.stack([x.ravel(), y.ravel()], -1) + 0.5
    follower.add(np.arange(len(start)), start, image(0), labels)
    for _ in range(MAX_GAP + 3):
        follower.step(COVER[: SIZE[0], : SIZE[1]], labels, flow)
    assert follower.seen.sum() <= 2
    follower.keep(np.zeros(0, int))
    follower.step(image(0), labels, flow)
    assert follower.points.shape == (0, 2)
