"""The path of a camera is smoothed where tracks do not tell its places, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flowsplat.geometry import Camera
from flowsplat.priors.cameras import smoothness
from flowsplat.priors.cameras.bundle import LENS_PARAMETERS, LensPrior, Reconstruction, adjust, residuals
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.refinement import refine
from flowsplat.priors.cameras.smoothness import MIN_FRAMES, SmoothnessPrior, differences, smooth_path
from tests.priors.cameras.worlds import FOCAL, HEIGHT, WIDTH, centered, observed, path, state_of, world


def shaken(cameras: list[Camera], amount: float, seed: int = 5) -> list[Camera]:
    """The same path with a random shift in every frame."""
    rng, result = np.random.default_rng(seed), []
    for camera in cameras:
        viewmat = camera.viewmat.copy()
        viewmat[:3, 3] += rng.normal(0, amount, 3)
        result.append(Camera(viewmat, camera.K, WIDTH, HEIGHT))
    return result


def solved(cameras: list[Camera], points: np.ndarray, noise: float) -> tuple[Reconstruction, Observations]:
    """What the tracks alone say."""
    positions, seen = centered(observed(cameras, points, noise))
    tracks = seen.sum(1) >= 2
    observations = Observations.of(positions[tracks], seen[tracks])
    start = state_of(cameras, points[tracks])
    done = adjust(start, observations, iterations=30, scale=1.0, fixed_camera=0, free_focal=False, tolerance=1e-7)
    return done.reconstruction, observations


def smooth(state: Reconstruction, observations: Observations) -> Reconstruction:
    lens = LensPrior(FOCAL, 1.0)
    return smooth_path(state, observations, scale=1.0, fixed_camera=0, lens=lens, free_focal=False, free_distortion=False)


def off(state: Reconstruction, cameras: list[Camera]) -> float:
    """Root mean square of what is wrong with the third differences, at the scale of the truth."""
    true = state_of(cameras, state.points)
    scale = np.linalg.norm(np.diff(true.centers, axis=0)) / np.linalg.norm(np.diff(state.centers, axis=0))
    return float(np.sqrt(np.mean((scale * differences(state) - differences(true)) ** 2)))


def test_derivatives_are_those_of_the_differences():
    state, rng = state_of(shaken(path(6), 0.1), world(4)), np.random.default_rng(0)
    J, step = smoothness._derivatives(state), rng.normal(0, 1e-6, 36)
    turns = np.array([[[0, -c, b], [c, 0, -a], [-b, a, 0]] for a, b, c in step.reshape(6, 6)[:, :3]]) + np.eye(3)
    moved = replace(state, rotations=turns @ state.rotations, translations=state.translations + step.reshape(6, 6)[:, 3:])
    np.testing.assert_allclose((differences(moved) - differences(state)).ravel(), J @ step, atol=1e-10)


def test_the_prior_adds_the_gradient_of_its_cost():
    state, rng = state_of(shaken(path(6), 0.1), world(4)), np.random.default_rng(1)
    prior, shift = SmoothnessPrior(rng.uniform(1, 3, 3)), rng.normal(0, 1e-6, (6, 3))
    H, g = np.zeros((36 + LENS_PARAMETERS, 36 + LENS_PARAMETERS)), np.zeros(36 + LENS_PARAMETERS)
    prior.add_to(H, g, state)
    there, back = (prior.compute_cost(replace(state, translations=state.translations + sign * shift)) for sign in (1, -1))
    step = np.zeros(36)
    step.reshape(6, 6)[:, 3:] = shift
    # g and H are halves of the derivatives of a cost, as they are of squared residuals.
    assert there - back == pytest.approx(-4 * g[:36] @ step, rel=1e-6)
    assert there + back - 2 * prior.compute_cost(state) == pytest.approx(2 * step @ H[:36, :36] @ step, rel=1e-3)
    assert not H[36:].any()
    assert not g[36:].any()


def test_a_path_that_tracks_hardly_tell_becomes_smooth():
    """A hand's breadth on 25 frames before a landscape: one frame's shift is within the noise of its tracks."""
    cameras, points = path(25, travel=0.15), world(150)
    state, observations = solved(cameras, points, 0.2)
    found = smooth(state, observations)
    assert off(found, cameras) < 0.25 * off(state, cameras)
    before, after = (np.median(residuals(each, observations)[0]) for each in (state, found))
    assert after < 1.05 * before


def test_a_camera_that_shakes_keeps_its_shake():
    cameras, points = shaken(path(25), 0.05), world(150)
    state, observations = solved(cameras, points, 0.2)
    found = smooth(state, observations)
    assert off(found, cameras) < 1.02 * off(state, cameras)
    true = np.median(np.abs(differences(state_of(cameras, points))))
    assert np.median(np.abs(differences(found))) == pytest.approx(true, rel=0.1)


def test_a_jolt_is_kept():
    cameras, points = path(25, travel=0.15), world(150)
    for camera in cameras[12:]:
        camera.viewmat[:3, 3] -= camera.viewmat[:3, :3] @ [0.4, 0.0, 0.0]
    state, observations = solved(cameras, points, 0.2)
    found, true = smooth(state, observations), state_of(cameras, points)
    jolts = [np.linalg.norm(np.diff(each.centers, axis=0), axis=1).max() for each in (found, true)]
    assert jolts[0] == pytest.approx(jolts[1], rel=0.1)
    calm = np.r_[0:9, 14:22]
    wrong = [np.mean((differences(each) - differences(true))[calm] ** 2) for each in (state, found)]
    assert wrong[1] < 0.5 * wrong[0]


def test_the_extent_of_the_path_stays():
    """A shorter path would be a smoother one; what is small must not become smaller still."""
    cameras, points = path(20, travel=0.3), world(150)
    state, observations = solved(cameras, points, 0.1)
    found = smooth(state, observations)
    extents = [np.linalg.norm(each.centers[-1] - each.centers[0]) for each in (state, found)]
    assert extents[1] == pytest.approx(extents[0], rel=0.1)


def test_few_frames_and_a_standing_camera_are_left_alone():
    state, observations = solved(path(MIN_FRAMES - 1), world(80), 0.2)
    assert smooth(state, observations) is state
    still = replace(state_of(path(12, travel=0.0), world(80)), translations=np.zeros((12, 3)))
    positions, seen = centered(observed(path(12, travel=0.0), world(80), 0.1))
    assert smooth(still, Observations.of(positions, seen)) is still


def test_the_last_refinement_of_frames_that_follow_each_other_is_smooth():
    cameras, points = path(25, travel=0.15), world(150)
    positions, seen = centered(observed(cameras, points, 0.2))
    keep = seen.sum(1) >= 2
    found = [
        refine(
            state_of(cameras, points[keep]), Observations.of(positions[keep], seen[keep]), fixed_camera=0, expected_focal=FOCAL,
            free_focal=False, consecutive=each,
        ).state
        for each in (False, True)
    ]  # fmt: skip
    assert off(found[1], cameras) < 0.5 * off(found[0], cameras)
