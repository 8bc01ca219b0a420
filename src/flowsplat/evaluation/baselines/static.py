"""Our own scene without motion, which ``--baselines all`` trains."""

from __future__ import annotations

import numpy as np

from flowsplat.common.registry import Entry
from flowsplat.evaluation.baselines import BASELINES, Baseline, HeldoutImage


def render_without_motion(image: HeldoutImage) -> np.ndarray | None:
    """Return what it renders, where it was trained."""
    return None if image.render_static is None else image.render_static()


BASELINES.add(Entry("static", "our static scene", "Our own scene without motion.", Baseline(render_without_motion), place=50))
