"""A point goes unseen behind something, and is found again."""

from __future__ import annotations

import numpy as np

from flowsplat.priors.tracks.following import LONGEST_GAP, Follower
from flowsplat.scenes import Flow

from .textures import shifted, texture

SIZE = (90, 140)
VELOCITY = np.array([2.0, 0.5])
WORLD, POST = texture(150, 260), texture(150, 260, seed=3, blobs=0.7) // 3


def picture(i: int, hidden: bool) -> np.ndarray:
    """A texture that moves; a post that stands still before it from column 60 to 72."""
    image = shifted(WORLD, 2.0 * i, 0.5 * i, SIZE[1], SIZE[0])
    if hidden:
        image[:, 60:72] = POST[: SIZE[0], 60:72]
    return image


def follow(hidden: bool, frames: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Points [P, T, 2] that start left of the post, and where they were seen [P, T]."""
    y, x = np.mgrid[12:60:6, 22:52:6]
    start = np.stack([x.ravel(), y.ravel()], -1) + 0.5
    labels, sure = np.zeros(SIZE, np.int32), np.ones(SIZE, np.float32)
    flow = Flow(0, 1, np.broadcast_to(np.float32(VELOCITY), (*SIZE, 2)).copy(), sure)
    if hidden:
        flow.flow[:, 60:72] = 0
    follower = Follower()
    follower.add(np.arange(len(start)), start, picture(0, hidden), labels)
    points, seen = np.full((len(start), frames, 2), np.nan), np.zeros((len(start), frames), bool)
    for i in range(frames):
        if i:
            follower.step(picture(i, hidden), labels, flow)
        points[follower.ids, i], seen[follower.ids, i] = follower.points, follower.seen
    return points, seen


def test_in_the_open_all_points_live():
    points, seen = follow(hidden=False)
    assert seen.mean() > 0.97
    travelled = points[:, 23] - points[:, 0]
    assert np.nanmedian(np.linalg.norm(travelled - 23 * VELOCITY, axis=1)) < 0.1


def test_behind_a_post_points_are_not_seen_and_behind_it_they_are_found():
    points, seen = follow(hidden=True)
    true = points[:, :1] + np.arange(24)[:, None] * VELOCITY
    behind = (true[..., 0] > 62) & (true[..., 0] < 70)
    past = true[..., 0] > 82
    assert seen[behind].mean() < 0.35
    assert seen[past].mean() > 0.6
    assert np.median(np.linalg.norm(points - true, axis=-1)[seen & past]) < 0.3
    assert (np.linalg.norm(points - true, axis=-1)[seen] < 2).mean() > 0.95


def test_what_never_comes_back_is_given_up():
    labels, sure = np.zeros(SIZE, np.int32), np.ones(SIZE, np.float32)
    flow = Flow(0, 1, np.zeros((*SIZE, 2), np.float32), sure)
    follower = Follower()
    follower.add(np.array([7]), np.array([[50.5, 40.5]]), picture(0, False), labels)
    follower.step(POST[: SIZE[0], : SIZE[1]], labels, flow)
    assert len(follower.ids) == 0  # nobody to go with
    y, x = np.mgrid[20:60:8, 20:80:8]
    start = np.stack([x.ravel(), y.ravel()], -1) + 0.5
    follower.add(np.arange(len(start)), start, picture(0, False), labels)
    for _ in range(LONGEST_GAP + 3):
        follower.step(POST[: SIZE[0], : SIZE[1]], labels, flow)
    assert follower.seen.sum() <= 2
    follower.keep(np.zeros(0, int))
    follower.step(picture(0, False), labels, flow)
    assert follower.points.shape == (0, 2)
