"""A baseline of the evaluation: the training frame that is nearest in time."""

from __future__ import annotations

import numpy as np

from flowsplat.common.registry import Entry
from flowsplat.evaluation.baselines import BASELINES, Baseline, HeldoutImage, to_float


def nearest_frame(image: HeldoutImage) -> np.ndarray:
    """Return it as it is."""
    before, after, fraction = image.neighbors
    return to_float(before if fraction <= 0.5 else after)


NEAREST = Baseline(nearest_frame, of_views=False)
BASELINES.add(Entry("nearest", "nearest frame, copied", "The training frame that is nearest in time.", NEAREST))
