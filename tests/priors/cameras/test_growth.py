from __future__ import annotations

import numpy as np

from flowsplat.priors.cameras.growth import triangulate
from flowsplat.priors.cameras.observations import Observations
from tests.priors.cameras.worlds import centered, observed, path, state_of, world


def test_triangulation_finds_points():
    cameras, points = path(6), world(50)
    positions, seen = centered(observed(cameras, points, 0.0))
    seen[0] = False
    often = seen.sum(1) >= 2
    np.testing.assert_allclose(
        triangulate(state_of(cameras, points), Observations.of(positions, seen))[often], points[often], atol=1e-6
    )
