from __future__ import annotations

import numpy as np

from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.selection import CELL_GRID, choose_tracks
from tests.priors.cameras.worlds import HEIGHT, WIDTH


def test_chosen_tracks_cover_the_image_and_prefer_long_ones():
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, [WIDTH, HEIGHT], (3000, 1, 2)).repeat(10, 1)
    lengths = rng.integers(1, 11, 3000)
    seen = np.arange(10) < lengths[:, None]
    chosen = choose_tracks(Observations.of(positions, seen), WIDTH, HEIGHT, per_cell=4)
    assert lengths[chosen].min() >= 3
    assert lengths[chosen].mean() > 7
    cell = (positions[chosen, 0] / [WIDTH, HEIGHT] * CELL_GRID).astype(int)
    assert len(np.unique(cell, axis=0)) == CELL_GRID[0] * CELL_GRID[1]
