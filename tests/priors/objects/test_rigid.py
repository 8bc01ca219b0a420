"""Structure from motion in an object's own frame."""

from __future__ import annotations

import numpy as np
import pytest

from flowsplat.geometry import Camera
from flowsplat.priors.objects import rigid
from flowsplat.priors.objects.contact import Bound
from flowsplat.priors.objects.depth_trajectory import rigid_motions
from flowsplat.priors.objects.rigid import TrackObservations, longest, solve_rigid, widest_turn
from flowsplat.priors.objects.rigid_equations import solve_band, unpack_band
from flowsplat.priors.objects.shape_offset import place_points
from flowsplat.priors.objects.solving import solve_object

K = np.array([[300.0, 0, 160], [0, 300.0, 90], [0, 0, 1]])
FRAMES = 24


def turn(angle: float, axis: int = 1) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(3)
    i, j = [k for k in range(3) if k != axis]
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def body(count: int = 80, seed: int = 0) -> np.ndarray:
    """Points on the front half of an ellipsoid."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points * [0.5, 0.4, 0.3]


def seen_body(points: np.ndarray, degrees: float, noise: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels [N, T, 2], where they count [N, T], and the depth [T] of the middle, of a body that turns, passes and comes nearer."""
    rng = np.random.default_rng(seed)
    pixels = np.zeros((len(points), FRAMES, 2), np.float32)
    depths = np.linspace(6, 4, FRAMES)
    for t in range(FRAMES):
        place = points @ turn(np.radians(degrees) * t / FRAMES).T + [-1 + 2 * t / FRAMES, 0.2 * np.sin(t / 4), depths[t]]
        pixels[:, t] = place[:, :2] / place[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2] + rng.normal(0, noise, (len(points), 2))
    seen = np.ones((len(points), FRAMES), bool)
    seen[::3, : FRAMES // 3] = False
    seen[1::3, 2 * FRAMES // 3 :] = False
    return pixels, seen, depths


def flat(k: int) -> np.ndarray:
    return np.zeros((180, 320), np.float32)


@pytest.mark.parametrize("degrees", [15, 90])
def test_relative_depth_over_time(degrees):
    pixels, seen, depths = seen_body(body(), degrees, 0.2)
    motion = solve_rigid(TrackObservations.of_tracks(pixels, seen, K))
    assert motion is not None
    assert motion.inliers > 0.95
    error = motion.log_depths() - np.log(depths)
    assert np.std(error) < 0.015


def test_shape_offset_and_turn_of_what_turns():
    points = body()
    pixels, seen, depths = seen_body(points, 90, 0.2)
    observations = TrackObservations.of_tracks(pixels, seen, K)
    motion = solve_rigid(observations)
    assert motion is not None
    assert motion.widest_turn() == pytest.approx(90 * (FRAMES - 1) / FRAMES, abs=4)
    found, share = place_points(motion, observations, K)
    assert share > 0.95
    middle = np.argsort(np.abs(found.frame_of - FRAMES // 2), kind="stable")[: (found.frame_of == FRAMES // 2).sum()]
    tracks = observations.point_of[observations.frame_of == FRAMES // 2]
    assert len(tracks) == len(middle)
    true = np.log((points @ turn(np.radians(90) * (FRAMES // 2) / FRAMES).T)[tracks, 2] + depths[FRAMES // 2])
    error = found.log_depth[middle] - true
    assert np.std(error) < 0.004
    assert np.std(true) > 0.04


def test_what_is_known_of_a_point_says_how_sure_it_is():
    turned = [solve_rigid(TrackObservations.of_tracks(*seen_body(body(), degrees, 0.2)[:2], K)) for degrees in (10, 90)]
    sigmas = [float(np.median(place_points(each, each.observations, K)[0].sigma)) for each in turned if each is not None]
    assert sigmas[0] > 2 * sigmas[1]


def test_what_bends_is_not_believed():
    rng = np.random.default_rng(3)
    pixels, seen, _ = seen_body(body(), 60, 0.2)
    assert rigid_motions(pixels, seen, K)[0] is not None
    wobble = np.cumsum(rng.normal(0, 3, (len(pixels), FRAMES, 2)), 1)
    assert rigid_motions((pixels + wobble).astype(np.float32), seen, K)[0] is None


@pytest.mark.parametrize("stands", [True, False])
def test_a_motion_that_explains_half_of_an_object_tells_its_depth_trajectory_if_its_feet_keep_to_the_ground(stands):
    rng = np.random.default_rng(3)
    pixels, seen, depths = seen_body(body(160), 60, 0.2)
    pixels[::2] += np.cumsum(rng.normal(0, 3, (80, FRAMES, 2)), 1)
    motion, found = rigid_motions(pixels, seen, K)
    assert motion is None
    assert found
    cameras = [Camera(np.eye(4), K, 320, 180) for _ in range(FRAMES)]
    middles = np.median(pixels, 0).astype(float)
    swing = np.zeros(FRAMES) if stands else 0.4 * np.sin(np.arange(FRAMES) / 2)
    feet = np.log(depths) + swing
    bounds = [Bound(float(each), float(each), True, True, np.zeros((3, 2), int)) for each in feet]
    billboards = 1.2 + 0.3 * np.sin(np.arange(FRAMES) / 3)
    obj = solve_object(1, pixels, seen, middles, bounds, cameras, None, billboards, np.array([0, -1.0, 0]), flat)
    assert not obj.rigid
    if stands:
        assert set(obj.cues) == {"contact"}
        np.testing.assert_allclose(obj.log_depth, np.log(depths), atol=0.05)
    else:
        # Nothing tells its depth trajectory, so the billboards do.
        assert not obj.cues
        np.testing.assert_allclose(np.ptp(obj.log_depth - billboards), 0, atol=1e-6)


def test_what_is_deep_touches_the_ground_before_its_middle():
    """The lowest pixels of a body that turns, a little nearer to the camera than its middle in each frame."""
    points = body(400)
    pixels, seen, depths = seen_body(points, 60, 0.1)
    own = np.stack([points @ turn(np.radians(60) * k / FRAMES).T for k in range(FRAMES)], 1)  # [N, T, 3]
    seen &= own[..., 2] < 0
    front = np.argsort(np.where(own[..., 1] > 0.2, own[..., 2], np.inf), axis=0)[:3]
    nearer = np.log1p(np.median(np.take_along_axis(own[..., 2], front, 0), 0) / depths)
    assert nearer.max() < -0.035
    lowest = np.log(depths) + nearer
    bounds = [Bound(float(each), float(each), True, True, pixels[front[:, k], k].astype(int)) for k, each in enumerate(lowest)]
    cameras = [Camera(np.eye(4), K, 320, 180) for _ in range(FRAMES)]
    middles = np.median(pixels, 0).astype(float)
    obj = solve_object(1, pixels, seen, middles, bounds, cameras, None, np.log(depths), np.array([0, -1.0, 0]), flat)
    assert obj.rigid
    assert set(obj.cues) == {"contact"}
    errors = []
    for pixel, k, log_depth in zip(obj.points.pixels, obj.points.frame_of, obj.points.log_depth, strict=True):
        away = np.where(seen[:, k], ((pixels[:, k] - pixel) ** 2).sum(1), np.inf)
        errors.append(log_depth - np.log(own[away.argmin(), k, 2] + depths[k]))
    assert abs(np.median(errors)) < 0.025


@pytest.mark.parametrize("stands", [True, False])
def test_a_motion_that_growth_and_the_ground_contradict_is_dropped(stands):
    pixels, seen, depths = seen_body(body(160), 60, 0.2)
    assert rigid_motions(pixels, seen, K)[0] is not None
    cameras = [Camera(np.eye(4), K, 320, 180) for _ in range(FRAMES)]
    middles = np.median(pixels, 0).astype(float)
    growth = 1.2 + 0.4 * np.sin(np.arange(FRAMES) / 3)
    feet = growth + 0.1 if stands else np.log(depths) + np.linspace(0, 2, FRAMES)
    bounds = [Bound(float(each), float(each), True, True, np.zeros((3, 2), int)) for each in feet]
    obj = solve_object(1, pixels, seen, middles, bounds, cameras, None, growth, np.array([0, -1.0, 0]), flat)
    assert obj.rigid != stands
    assert ("contact" in obj.cues) == stands


def test_too_little_to_know():
    pixels, seen, _ = seen_body(body(10), 60, 0.2)
    assert rigid_motions(pixels, seen, K) == (None, [])
    assert solve_rigid(TrackObservations.of_tracks(pixels[:0], seen[:0], K)) is None
    assert solve_rigid(TrackObservations.of_tracks(pixels[:4], seen[:4], K)) is None


def test_longest_tracks_fill_every_frame():
    seen = np.zeros((30, 10), bool)
    for n in range(30):
        seen[n, n % 5 : n % 5 + 3 + n % 4] = True
    chosen = longest(seen, 5)
    assert (seen[chosen].sum(0)[:8] >= 5).all()
    assert len(chosen) < 15
    assert len(longest(seen[:0])) == 0


def test_widest_turn():
    turns = np.stack([turn(a) for a in (0.0, 0.3, 1.0)])
    assert widest_turn(turns) == pytest.approx(np.degrees(1.0), abs=1e-6)
    assert widest_turn(turns[:1]) == 0


def test_a_long_clip_is_solved_as_well():
    """Points live for 12 of 160 frames: its system is a band, and it is adjusted less and less often while it grows."""
    rng = np.random.default_rng(0)
    frames, life = 160, 12
    points, starts = rng.normal(size=(frames, 3)) * [0.3, 0.2, 0.25], np.arange(frames) - life // 2
    depths = 3 + 0.5 * np.sin(np.arange(frames) / 30)
    pixels, seen = np.zeros((frames, frames, 2)), np.zeros((frames, frames), bool)
    for t in range(frames):
        turn = 0.02 * t
        R = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        placed = points @ R.T + [0.3 * np.sin(t / 20), 0, depths[t]]
        pixels[:, t] = placed[:, :2] / placed[:, 2:] * K[0, 0] + K[:2, 2] + 0.2 * rng.normal(size=(frames, 2))
        seen[:, t] = (t >= starts) & (t < starts + life)
    motion = solve_rigid(TrackObservations.of_tracks(pixels, seen, K))
    assert motion is not None
    assert motion.inliers > 0.99
    depth_trajectory = motion.log_depths()[10:-10] - np.log(depths)[10:-10]
    assert np.std(depth_trajectory) < 0.08


def test_points_that_last_for_long_are_several(monkeypatch):
    pixels, seen, depths = seen_body(body(), 60, 0.2)
    observations = TrackObservations.of_tracks(pixels, seen, K)
    whole = observations.in_pieces()
    np.testing.assert_array_equal(whole.first, observations.first)
    monkeypatch.setattr(rigid, "_PIECE_FRAMES", 12)
    np.testing.assert_array_equal(observations.in_pieces().first, observations.first, "none of them is long")
    monkeypatch.setattr(rigid, "_MAX_TRACK_FRAMES", 14)
    cut = observations.in_pieces()
    assert observations.points < cut.points <= 4 * observations.points
    np.testing.assert_array_equal(cut.x, observations.x)
    for first, last in zip(cut.first, cut.first[1:], strict=False):
        assert 0 < cut.frame_of[last - 1] - cut.frame_of[first] + 1 <= 12
        assert (np.diff(cut.frame_of[first:last]) > 0).all()
    crossed = {t for first, last in zip(cut.first, cut.first[1:], strict=False) for t in cut.frame_of[first + 1 : last]}
    assert crossed == set(range(1, FRAMES)), "no frame at which all are cut"
    motion = solve_rigid(cut)
    assert motion is not None
    assert motion.inliers > 0.95
    assert np.std(motion.log_depths() - np.log(depths)) < 0.03


@pytest.mark.parametrize("band", [12, 24, 50])
def test_a_band_is_solved_as_the_whole_matrix(band):
    rng = np.random.default_rng(0)
    size = 60
    H = np.triu(np.tril(rng.normal(size=(size, size)), band - 1), 1 - band)
    H = H + H.T + 60 * np.eye(size)
    packed, b = np.zeros((size, band)), rng.normal(size=size)
    for d in range(band):
        packed[: size - d, d] = np.diag(H, d)
    np.testing.assert_array_equal(unpack_band(packed), H)
    np.testing.assert_allclose(solve_band(packed, b), np.linalg.solve(H, b), atol=1e-9)
