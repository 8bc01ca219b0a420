"""Select the tracks that cameras are computed from: long ones, spread over all frames and over the image."""

from __future__ import annotations

import numpy as np

from flowsplat.priors.cameras.observations import Observations

CELL_GRID = (8, 6)
"""Columns and rows of the cells that tracks are spread over. Chosen by eye."""
RIM_WIDTH = 1 / 12
"""Of the image's width and height: an object of 70 % of the image in its middle leaves the rim free."""


def choose_tracks(seen: Observations, width: float, height: float, per_cell: int, shortest: int = 3) -> np.ndarray:
    """Return indices of tracks, longest first, until every cell of every frame holds about ``per_cell`` of them.

    Args:
        seen: in pixels of the frames.
        shortest: frames that a track must have been seen in.
    """
    lengths, first = seen.counts, seen.first
    where = seen.uv / [width, height] * CELL_GRID
    column, row = np.clip(where.astype(int), 0, np.array(CELL_GRID) - 1).T
    cell = (seen.camera * CELL_GRID[1] + row) * CELL_GRID[0] + column
    room = np.full(seen.cameras * CELL_GRID[0] * CELL_GRID[1], per_cell)
    chosen = []
    for n in np.argsort(-lengths, kind="stable"):
        if lengths[n] < shortest:
            break
        cells = cell[first[n] : first[n + 1]]
        if (room[cells] > 0).mean() > 0.3:
            room[cells] -= 1
            chosen.append(n)
    return np.sort(np.array(chosen, int))


def on_rim(seen: Observations, width: float, height: float) -> np.ndarray:
    """Return [M] bool: observations, in pixels of the frames, within ``RIM_WIDTH`` of the image's border."""
    place = seen.uv / [width, height]
    return np.any((place < RIM_WIDTH) | (place > 1 - RIM_WIDTH), axis=-1)


def mostly_on_rim(seen: Observations, width: float, height: float) -> np.ndarray:
    """Return [N] bool: tracks of which more than half of the observations are ``on_rim``."""
    return np.bincount(seen.point, on_rim(seen, width, height), seen.points) > 0.5 * seen.counts
