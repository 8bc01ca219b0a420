from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowsplat.priors.cameras.bundle import Reconstruction, adjust, rays, residuals
from flowsplat.priors.cameras.observations import Observations
from tests.priors.cameras.worlds import FOCAL, bend, centered, observed, path, state_of, world


def test_bundle_adjustment_undoes_a_perturbation():
    cameras, points, rng = path(8), world(300), np.random.default_rng(3)
    positions, seen = centered(observed(cameras, points, 0.0))
    true = state_of(cameras, points)
    turned = Rotation.from_rotvec(rng.normal(0, 0.01, (8, 3))).as_matrix() @ true.rotations
    shifted = true.translations + rng.normal(0, 0.02, (8, 3))
    turned[0], shifted[0] = true.rotations[0], true.translations[0]
    start = Reconstruction(turned, shifted, 1.1 * FOCAL, points + rng.normal(0, 0.05, points.shape))
    observations = Observations.of(positions, seen)
    before, _ = residuals(start, observations)
    done = adjust(start, observations, iterations=50, scale=5.0, fixed_camera=0, tolerance=1e-12)
    after, depth = residuals(done.reconstruction, observations)
    assert np.median(before) > 3
    assert after.max() < 1e-3
    assert (depth > 0).all()
    assert done.reconstruction.focal == pytest.approx(FOCAL, rel=1e-4)
    assert done.focal_precision > 0
    np.testing.assert_array_equal(done.reconstruction.rotations[0], true.rotations[0])


def test_bundle_adjustment_holds_what_is_fixed():
    cameras, points = path(5), world(100)
    positions, seen = centered(observed(cameras, points, 0.3))
    start = state_of(cameras, points)
    done = adjust(
        start, Observations.of(positions, seen), iterations=5, scale=1.0, fixed_camera=2, free_focal=False,
        free_translations=False,
    )  # fmt: skip
    assert done.reconstruction.focal == FOCAL
    np.testing.assert_array_equal(done.reconstruction.translations, start.translations)
    np.testing.assert_allclose(done.reconstruction.rotations[2], start.rotations[2], atol=1e-14)


def test_bundle_adjustment_finds_the_distortion():
    cameras, points = path(10), world(300)
    positions = bend(observed(cameras, points, 0.05), -0.12)
    start = state_of(cameras, points)
    flat, seen = centered(positions)
    done = adjust(
        start, Observations.of(flat, seen), iterations=50, scale=1.0, fixed_camera=0, free_distortion=True, tolerance=1e-9,
    )  # fmt: skip
    assert done.reconstruction.distortion == pytest.approx(-0.12, rel=0.02)
    assert done.distortion_precision > 0
    pinhole = adjust(start, Observations.of(flat, seen), iterations=50, scale=1.0, fixed_camera=0, tolerance=1e-9)
    assert pinhole.reconstruction.distortion == 0
    assert done.cost < 0.5 * pinhole.cost


@pytest.mark.parametrize("distortion", [-0.2, 0.0, 0.3])
def test_rays_undo_the_distortion(distortion):
    x = np.random.default_rng(0).uniform(-0.7, 0.7, (50, 2))
    uv = 400 * x * (1 + distortion * (x**2).sum(1, keepdims=True))
    np.testing.assert_allclose(rays(uv, 400.0, distortion), x, atol=1e-8)


def test_derivatives_of_the_distorted_projection():
    """One Gauss-Newton step from nearby must fall much nearer: it does so only with the right derivatives."""
    cameras, points = path(6), world(80)
    uv = bend(observed(cameras, points, 0.0), 0.2)
    flat, seen = centered(uv)
    true = state_of(cameras, points)
    observations = Observations.of(flat, seen)
    start = Reconstruction(true.rotations, true.translations, 1.001 * FOCAL, points, distortion=0.201)
    before, _ = residuals(start, observations)
    done = adjust(
        start, observations, iterations=1, scale=100.0, fixed_camera=0, free_translations=False, free_distortion=True,
    )  # fmt: skip
    after, _ = residuals(done.reconstruction, observations)
    assert np.median(after) < 0.05 * np.median(before)


def test_far_points_do_not_hold_up_the_focal_length():
    """A long way along a narrow valley: points a hundred times as far as others, whose distance hardly shows, and a bent path."""
    rng = np.random.default_rng(5)
    turns = np.linspace(-0.25, 0.25, 20)
    rotations = Rotation.from_rotvec(turns[:, None] * [0, 1, 0]).as_matrix()
    middles = 6 * np.stack([-np.sin(turns), 0 * turns, 1 - np.cos(turns)], 1)
    near = rng.uniform([-2, -1.5, 5], [2, 1.5, 8], (200, 3))
    z = rng.uniform(500, 900, 200)
    far = np.stack([rng.uniform(-0.4, 0.4, 200) * z, rng.uniform(-0.3, 0.3, 200) * z, z], 1)
    points = np.concatenate([near, far])
    places = np.einsum("tij,tnj->nti", rotations, points[None] - middles[:, None])
    positions = FOCAL * places[..., :2] / places[..., 2:] + rng.normal(0, 0.03, (400, 20, 2))
    true = Reconstruction(rotations, -np.einsum("tij,tj->ti", rotations, middles), FOCAL, points)
    # What a focal length that is 3 % off looks like once all else is adjusted to it.
    since = rng.integers(0, 11, (400, 1))
    observations = Observations.of(positions, (np.arange(20) >= since) & (np.arange(20) < since + 10))
    wrong = adjust(
        Reconstruction(true.rotations, true.translations, 0.97 * FOCAL, points), observations, iterations=60, scale=0.2,
        fixed_camera=6, free_focal=False, tolerance=1e-9,
    )  # fmt: skip
    done = adjust(wrong.reconstruction, observations, iterations=40, scale=0.2, fixed_camera=6, tolerance=1e-5)
    assert done.reconstruction.focal == pytest.approx(FOCAL, rel=1e-3)
