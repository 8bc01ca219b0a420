"""A few of many."""

from __future__ import annotations

import numpy as np


def spread(count: int, wanted: int) -> list[int]:
    """Return indices of at most ``wanted`` of ``count`` things, evenly from the first to the last."""
    return np.unique(np.linspace(0, count - 1, wanted).round().astype(int)).tolist()
