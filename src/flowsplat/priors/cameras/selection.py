"""Select the tracks that cameras are computed from: long ones, spread over all frames and over the image."""

from __future__ import annotations

import numpy as np

CELL_GRID = (8, 6)
"""Columns and rows of the cells that tracks are spread over. Chosen by eye."""
RIM_WIDTH = 1 / 12
"""Of the image's width and height: an object of 70 % of the image in its middle leaves the rim free."""


def choose_tracks(
    positions: np.ndarray, seen: np.ndarray, width: float, height: float, per_cell: int, shortest: int = 3
) -> np.ndarray:
    """Return indices of tracks, longest first, until every cell of every frame holds about ``per_cell`` of them.

    Args:
        positions: [N, T, 2] pixels of the frames.
        seen: [N, T].
        shortest: frames that a track must have been seen in.
    """
    lengths = seen.sum(1)
    track, frame = np.nonzero(seen)
    where = positions[track, frame] / [width, height] * CELL_GRID
    column, row = np.clip(where.astype(int), 0, np.array(CELL_GRID) - 1).T
    cell = (frame * CELL_GRID[1] + row) * CELL_GRID[0] + column
    first = np.searchsorted(track, np.arange(len(seen) + 1))
    room = np.full(seen.shape[1] * CELL_GRID[0] * CELL_GRID[1], per_cell)
    chosen = []
    for n in np.argsort(-lengths, kind="stable"):
        if lengths[n] < shortest:
            break
        cells = cell[first[n] : first[n + 1]]
        if (room[cells] > 0).mean() > 0.3:
            room[cells] -= 1
            chosen.append(n)
    return np.sort(np.array(chosen, int))


def on_rim(positions: np.ndarray, width: float, height: float) -> np.ndarray:
    """Return [N, T] bool: observations within ``RIM_WIDTH`` of the image's border.

    Args:
        positions: [N, T, 2] pixels of the frames, NaN where not seen.
    """
    place = np.nan_to_num(positions) / [width, height]
    return ((place < RIM_WIDTH) | (place > 1 - RIM_WIDTH)).any(-1) & np.isfinite(positions[..., 0])
