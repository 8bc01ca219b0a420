"""Both neighboring training frames warped to the time between them by the flow from one to the other, then blended."""

from __future__ import annotations

import numpy as np

from flowsplat.common.registry import Entry
from flowsplat.evaluation.baselines import BASELINES, Baseline, HeldoutImage, to_float
from flowsplat.geometry.cameras import pixel_grid
from flowsplat.geometry.interpolation import sample_map
from flowsplat.priors.flow import dis_flow, gray


def interpolate_by_flow(image: HeldoutImage) -> np.ndarray:
    """Return the blend; where there is one neighbor only, that."""
    first, second, fraction = image.neighbors
    if first is second:
        return to_float(first)
    # Looked up at the target's pixels, not carried there: right to first order in the flow's gradient.
    before = _look_up(to_float(first), -fraction * dis_flow(gray(first), gray(second)))
    after = _look_up(to_float(second), -(1 - fraction) * dis_flow(gray(second), gray(first)))
    return (1 - fraction) * before + fraction * after


def _look_up(image: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Return the image whose pixel p is the pixel p + flow(p) of ``image``."""
    height, width = image.shape[:2]
    return sample_map(image, (pixel_grid(width, height) + flow).reshape(-1, 2)).reshape(image.shape)


SENTENCE = "Both neighboring frames, carried by their flow to the time between them, and blended."
INTERPOLATION = Baseline(interpolate_by_flow, of_views=False)
BASELINES.add(Entry("flow_interpolation", "flow interpolation (DIS)", SENTENCE, INTERPOLATION, place=30))
