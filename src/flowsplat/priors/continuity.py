"""Find where a clip holds together: pieces between cuts, and frames that show nothing."""

from __future__ import annotations

import numpy as np

from flowsplat.images.blank import is_blank
from flowsplat.scenes import Scene


def piece_numbers(count: int, breaks: list[int]) -> np.ndarray:
    """Return [count] int: the piece that every frame belongs to; ``breaks`` are the first frames of all pieces but the first."""
    return np.searchsorted(np.asarray(breaks, int), np.arange(count), side="right")


class Continuity:
    """Which training frames, by their position in ``scene.train_frames``, can be matched with each other.

    Attributes:
        pieces: [T] int, the piece within which cameras share a world. Cameras that were not estimated here share one.
    """

    def __init__(self, scene: Scene):
        self._scene = scene
        breaks = (scene.prior("cameras") or {}).get("breaks", [])
        self.pieces = piece_numbers(scene.num_frames, breaks)[scene.train_frames]
        self._blank: dict[int, bool] = {}

    def is_blank(self, k: int) -> bool:
        """Return whether a frame shows nothing."""
        if k not in self._blank:
            self._blank[k] = is_blank(self._scene.frame(self._scene.train_frames[k]))
        return self._blank[k]

    def same_piece(self, k: int, j: int) -> bool:
        """Return whether the cameras of two frames share a world."""
        return bool(self.pieces[k] == self.pieces[j])

    def are_joined(self, k: int, j: int) -> bool:
        """Return whether matches between two frames mean something."""
        return self.same_piece(k, j) and not self.is_blank(k) and not self.is_blank(j)
