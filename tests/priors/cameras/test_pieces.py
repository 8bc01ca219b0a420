from __future__ import annotations

import numpy as np

from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.pieces import find_breaks
from tests.priors.cameras.worlds import observed, path, world


def test_frames_that_nothing_joins_are_named():
    positions = observed(path(12), world(300), 0.1)
    cut = np.concatenate([positions, positions])
    cut[: len(positions), 6:] = np.nan
    cut[len(positions) :, :6] = np.nan
    assert find_breaks(Observations.of(cut), range(12)) == [6]
