"""Both neighboring training frames, weighted by time."""

from __future__ import annotations

import numpy as np

from flowsplat.common.registry import Entry
from flowsplat.evaluation.baselines import BASELINES, Baseline, HeldoutImage, to_float


def blend_neighbors(image: HeldoutImage) -> np.ndarray:
    """Return their weighted mean."""
    before, after, fraction = image.neighbors
    return (1 - fraction) * to_float(before) + fraction * to_float(after)


BLEND = Baseline(blend_neighbors, of_views=False)
BASELINES.add(Entry("blend", "blend of both neighbors", "Both neighboring frames, weighted by time.", BLEND, place=20))
