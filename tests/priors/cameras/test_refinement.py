from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowsplat.priors.cameras.bundle import residuals
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.refinement import place_points, ray_points
from tests.priors.cameras.worlds import centered, observed, path, state_of, world


def test_far_points_stay_in_front():
    cameras, points = path(6), world(50)
    far = np.concatenate([points, [[0.0, 0, 1e7], [1e6, 0, 2e7]]])
    seen = Observations.of(*centered(observed(cameras, far, 0.3)))
    state = state_of(cameras, points)
    placed = place_points(state, seen)
    _, depth = residuals(replace(state, points=placed), seen)
    assert (depth > 0).all()
    assert np.isfinite(placed).all()


def test_rays_of_a_turning_camera_meet_on_the_sphere():
    cameras, points = path(6, travel=0.0), world(80)
    seen = Observations.of(*centered(observed(cameras, points, 0.0)))
    often = seen.counts > 0
    rays = ray_points(state_of(cameras, points), seen)
    np.testing.assert_allclose(rays[often], (points / np.linalg.norm(points, axis=1, keepdims=True))[often], atol=1e-9)
