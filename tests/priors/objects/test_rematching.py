"""Points of a ball that turns and comes nearer, of which everything is known, matched anew from tracks that drift."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowsplat.geometry import Camera
from flowsplat.priors.objects.rematching import FARTHEST, ObjectImages, gray, rematch_object
from flowsplat.priors.objects.rigid import Observations, RigidMotion, longest, solve_rigid

FRAMES, WIDTH, HEIGHT, FOCAL, RADII = 20, 160, 120, 220.0, np.array([0.16, 0.2, 0.13])
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


@dataclass(frozen=True)
class Ball:
    """Its poses, images [T, H, W], masks, and tracks [N, T, 2] that last some frames and drift."""

    turns: np.ndarray
    shifts: np.ndarray
    images: np.ndarray
    masks: np.ndarray
    positions: np.ndarray
    inside: np.ndarray

    def surface(self, t: int, pixels: np.ndarray) -> np.ndarray:
        """Points [N, 3] in its own frame behind pixels [N, 2]; NaN beside it."""
        rays = np.concatenate([(pixels - K[:2, 2]) / FOCAL, np.ones((len(pixels), 1))], 1)
        d, o = rays @ self.turns[t] / RADII, -self.shifts[t] @ self.turns[t] / RADII
        a, b, c = (d**2).sum(1), d @ o, o @ o - 1
        inside = b**2 - a * c
        z = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.nan)
        return (z[:, None] * rays - self.shifts[t]) @ self.turns[t]

    def pixels(self, t: int, points: np.ndarray) -> np.ndarray:
        y = points @ self.turns[t].T + self.shifts[t]
        return FOCAL * y[:, :2] / y[:, 2:] + K[:2, 2]


@pytest.fixture(scope="module")
def ball() -> Ball:
    random = np.random.default_rng(3)
    t = np.arange(FRAMES)
    turns = Rotation.from_rotvec(np.outer(0.05 * (t - 9), [0.2, 1, 0.1])).as_matrix()
    shifts = np.stack([0.01 * t - 0.1, 0.02 * np.sin(t / 4), 1.1 - 0.008 * t], 1)
    empty = np.zeros((0, FRAMES))
    bare = Ball(turns, shifts, empty, empty, empty, empty)
    waves, phases = random.normal(0, 45, (30, 3)), random.uniform(0, 6, 30)
    grid = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1).reshape(-1, 2)
    images, masks = np.full((2, FRAMES, HEIGHT, WIDTH), 40, np.uint8)
    for k in t:
        points = bare.surface(k, grid)
        on = np.isfinite(points).all(1)
        brightness = 125 + 18 * np.sin(points[on] @ waves.T + phases).sum(1) + random.normal(0, 1.5, on.sum())
        image = np.full(len(grid), 40.0)
        image[on] = brightness
        images[k] = np.clip(image, 0, 255).reshape(HEIGHT, WIDTH)
        masks[k] = on.reshape(HEIGHT, WIDTH)
    positions, inside = [], []
    for first in range(0, FRAMES - 5, 2):
        y, x = np.nonzero(masks[first])
        chosen = random.choice(len(x), 25, replace=False)
        points = bare.surface(first, np.stack([x, y], 1)[chosen] + 0.5)
        track, seen = np.zeros((25, FRAMES, 2)), np.zeros((25, FRAMES), bool)
        for k in range(first, min(first + 8, FRAMES)):
            track[:, k] = bare.pixels(k, points)
            facing = np.einsum("ni,ni->n", points / RADII**2, points + shifts[k] @ turns[k]) < 0
            column, row = np.clip(track[:, k].astype(int), 0, [WIDTH - 1, HEIGHT - 1]).T
            seen[:, k] = facing & (masks[k][row, column] > 0) & (seen[:, k - 1] if k > first else True)
        # Tracks of one stretch share their drift, as they do where a matcher is drawn aside.
        drift = np.cumsum(random.normal(0, 0.12, (1, FRAMES, 2)) + random.normal(0, 0.12, track.shape), 1)
        positions.append(track + drift - drift[:, first : first + 1])
        inside.append(seen)
    every, seen = np.concatenate(positions), np.concatenate(inside)
    kept = seen.sum(1) >= 5
    return Ball(turns, shifts, images, masks > 0, every[kept], seen[kept])


def shown(ball: Ball, images: np.ndarray) -> ObjectImages:
    y, x = (np.array([np.nonzero(mask)[axis].mean() for mask in ball.masks]) for axis in (0, 1))
    cameras = [Camera(np.eye(4), K, WIDTH, HEIGHT)] * FRAMES
    return ObjectImages(images, ball.masks, np.stack([x, y], 1), cameras, np.array([0.0, -1, 0]))


def depth_trajectory_error(ball: Ball, motion: RigidMotion) -> float:
    """Standard deviation over time of ln depth of the points seen, against that of the surface behind them."""
    o, (off, depth, explained) = motion.observations, motion.residuals()
    errors = []
    for t in np.flatnonzero(motion.used):
        here = explained & (o.frame_of == t) & (off < 1.5)
        points = ball.surface(int(t), o.x[here] * FOCAL + K[:2, 2])
        errors.append(np.nanmedian(np.log(depth[here] / (points @ ball.turns[t].T + ball.shifts[t])[:, 2])))
    return float(np.std(errors))


@pytest.fixture(scope="module")
def by_tracks(ball) -> RigidMotion:
    chosen = longest(ball.inside)
    motion = solve_rigid(Observations.of_tracks(ball.positions[chosen], ball.inside[chosen], K))
    assert motion is not None
    return motion


def test_matches_are_truer_than_tracks_and_last_longer(ball, by_tracks):
    result = rematch_object(by_tracks, ball.positions, ball.inside, shown(ball, ball.images))
    assert result is not None
    motion, found, counts = result
    assert counts.sum(1).mean() > 1.5 * ball.inside.sum(1).mean()

    def errors(positions, seen):
        all_of_them = []
        for track, here in zip(positions, seen, strict=True):
            frames = np.flatnonzero(here)
            middle = frames[len(frames) // 2]
            point = ball.surface(int(middle), track[middle][None])
            if np.isfinite(point).all():
                all_of_them += [float(np.linalg.norm(ball.pixels(int(k), point)[0] - track[k])) for k in frames if k != middle]
        return np.array(all_of_them)

    before, after = errors(ball.positions, ball.inside), errors(found, counts)
    assert np.median(after) < 0.12
    assert np.median(after) < 0.5 * np.median(before)
    assert np.percentile(after, 95) < FARTHEST / 4
    assert depth_trajectory_error(ball, motion) < 0.6 * depth_trajectory_error(ball, by_tracks)


def test_a_change_of_light_changes_nothing(ball, by_tracks):
    brighter = np.clip(ball.images * np.linspace(0.6, 1.0, FRAMES)[:, None, None] + 10, 0, 255).astype(np.uint8)
    result = rematch_object(by_tracks, ball.positions, ball.inside, shown(ball, brighter))
    assert result is not None
    assert depth_trajectory_error(ball, result[0]) < 0.6 * depth_trajectory_error(ball, by_tracks)


def test_images_without_texture_say_nothing(ball, by_tracks):
    flat = np.where(ball.masks, 120, 40).astype(np.uint8)
    assert rematch_object(by_tracks, ball.positions, ball.inside, shown(ball, flat)) is None


def test_images_of_something_else_say_nothing(ball, by_tracks):
    noise = np.random.default_rng(0).integers(0, 255, ball.images.shape).astype(np.uint8)
    assert rematch_object(by_tracks, ball.positions, ball.inside, shown(ball, noise)) is None


def test_an_object_that_is_not_seen_has_no_surface(ball, by_tracks):
    hidden = replace(shown(ball, ball.images), masks=np.zeros_like(ball.masks))
    assert rematch_object(by_tracks, ball.positions, ball.inside, hidden) is None


def test_gray_is_brightness():
    image = np.zeros((9, 9, 3), np.uint8)
    image[...] = [200, 100, 50]
    assert np.abs(gray(image).astype(int) - 124).max() <= 1
