"""The first motion of objects: paths lie on arcs, bad flow of single pixels does no harm, and parts keep their own motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowsplat.gaussians.first_motion import fit_motion
from flowsplat.gaussians.observations import Observation, Observations
from flowsplat.geometry import Camera, Similarity
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.scenes import Flow

WIDTH, HEIGHT, FRAMES, MIDDLE = 96, 72, 9, 4
K = np.array([[80.0, 0, WIDTH / 2], [0, 80.0, HEIGHT / 2], [0, 0, 1]])
CENTER, TURN = np.array([WIDTH / 2, HEIGHT / 2]), 0.3
"""Of a disc that turns by so many radians a frame; frame 5 is held out."""
TIMES = np.array([0, 1, 2, 3, 4, 6, 7, 8, 9]) / 9
SIGMA, STEP = 1.1 / 9, 1 / 9


def turned(points: np.ndarray, steps: float) -> np.ndarray:
    c, s = np.cos(TURN * steps), np.sin(TURN * steps)
    return (points - CENTER) @ np.array([[c, s], [-s, c]]) + CENTER


def observations(move, mask: np.ndarray, spoil=None, image: np.ndarray | None = None) -> Observations:
    """A still camera before a flat object at depth 1; ``move`` takes points [N, 2] so many frames on."""
    grid = pixel_grid(WIDTH, HEIGHT).astype(np.float64)
    camera = Camera(np.eye(4), K, WIDTH, HEIGHT)
    image = np.full((HEIGHT, WIDTH, 3), 128, np.uint8) if image is None else image

    def flow(i: int, j: int) -> Flow | None:
        if not 0 <= j < FRAMES:
            return None
        moved = (move(grid.reshape(-1, 2), (TIMES[j] - TIMES[i]) / STEP).reshape(grid.shape) - grid).astype(np.float32)
        confidence = mask.astype(np.float32)
        return Flow(i, j, *(spoil(moved, confidence) if spoil else (moved, confidence)))

    depth = np.ones((HEIGHT, WIDTH), np.float32)
    frames = [
        Observation(i, float(TIMES[i]), camera, image, depth, depth > 0, mask.astype(np.uint8), flow(i, i + 1), flow(i, i - 1))
        for i in range(FRAMES)
    ]
    return Observations(frames, Similarity())


def place(observed: Observations, wanted: np.ndarray, steps: float) -> np.ndarray:
    """Where the fitted motion leads so many frames after the middle: pixels [N, 2]."""
    motion = fit_motion(observed, MIDDLE, wanted, SIGMA, 3, 3)
    y, x = np.nonzero(wanted)
    camera = observed[MIDDLE].camera
    start = camera.unproject(np.stack([x, y], 1) + 0.5, np.ones(len(x)))
    return camera.project(start + np.einsum("nok,o->nk", motion, (steps * STEP) ** np.arange(1, 4)))[0]


@pytest.fixture(scope="module")
def disc() -> np.ndarray:
    return np.linalg.norm(pixel_grid(WIDTH, HEIGHT) - CENTER, axis=-1) < 30


def test_between_frames_paths_lie_on_the_arc(disc):
    y, x = np.nonzero(disc)
    points = np.stack([x, y], 1) + 0.5
    true = turned(points, 1.0)
    chord = 0.5 * (points + turned(points, 2.0))
    error = np.linalg.norm(place(observations(turned, disc), disc, 1.0) - true, axis=1)
    inner = np.linalg.norm(points - CENTER, axis=1) < 27
    assert np.linalg.norm(chord - true, axis=1)[inner].max() > 1.1
    assert error[inner].max() < 0.4


def test_single_pixels_with_bad_flow_go_with_their_neighbors(disc):
    rng = np.random.default_rng(0)

    def spoil(flow, confidence):
        bad = rng.random(confidence.shape) < 0.3
        return np.where(bad[..., None], flow + rng.normal(0, 6, flow.shape), flow).astype(np.float32), confidence

    y, x = np.nonzero(disc)
    true = turned(np.stack([x, y], 1) + 0.5, 1.0)
    error = np.linalg.norm(place(observations(turned, disc, spoil), disc, 1.0) - true, axis=1)
    assert np.median(error) < 0.3
    assert np.percentile(error, 95) < 1.5


def test_pixels_that_no_flow_tells_move_with_the_part_of_their_color():
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[20:50, 20:76] = True
    left = np.zeros_like(mask)
    left[:, :48] = True
    image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    image[:, 48:] = 200

    def move(points, steps):
        return points + np.where(points[:, :1] < 48, [[0.0, 2.0 * steps]], [[0.0, -2.0 * steps]])

    unknown = np.zeros_like(mask)
    unknown[:, 44:52] = True
    observed = observations(move, mask, lambda flow, confidence: (flow, confidence * ~unknown), image)
    wanted = mask & unknown
    wanted[:26], wanted[44:] = False, False
    y, x = np.nonzero(wanted)
    moved = place(observed, wanted, 1.0) - np.stack([x, y], 1) - 0.5
    assert np.abs(moved[x < 48] - [0, 2]).max() < 0.3
    assert np.abs(moved[x >= 48] - [0, -2]).max() < 0.3


def test_without_any_flow_nothing_moves(disc):
    observed = observations(turned, disc, lambda flow, confidence: (flow, 0 * confidence))
    assert (fit_motion(observed, MIDDLE, disc, SIGMA, 3, 3) == 0).all()


def test_what_hides_an_object_does_not_tell_how_far_away_it_is():
    """Flow at an occlusion goes on over the nearer object, whose depth would make a path dart along the ray."""
    grid = pixel_grid(WIDTH, HEIGHT)
    object_ids = np.where(grid[..., 0] < 40, 1, 2).astype(np.uint8)
    observed = observations(lambda points, steps: points + [2.0 * steps, 0], object_ids > 0)
    depth = np.where(object_ids == 1, 0.4, 1).astype(np.float32)
    frames = [replace(frame, depth=depth, object_ids=object_ids) for frame in observed.frames]
    wanted = (grid[..., 0] > 40) & (grid[..., 0] < 50) & (grid[..., 1] > 30) & (grid[..., 1] < 40)
    motion = fit_motion(Observations(frames, Similarity()), MIDDLE, wanted, SIGMA, 3, 3)
    steps = np.array([-3, -1, 1, 3]) * STEP
    ahead = np.einsum("nok,to->tnk", motion, steps[:, None] ** np.arange(1, 4))
    assert np.abs(ahead[..., 2]).max() < 0.01
    np.testing.assert_allclose(ahead[2, :, 0], 2 / 80, atol=0.005)
