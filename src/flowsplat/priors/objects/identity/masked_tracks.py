"""Tracks and the parts of masks that they lie in."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

GAP = 0.004
"""Share of the long side by which parts are enlarged before they count as apart."""
INSIDE = 0.6
"""Share of its visible frames that a track must be inside masks."""
SHORTEST = 3
"""Frames of a track inside masks."""


@dataclass
class MaskedTracks:
    """Tracks and the parts of masks that they lie in, over the training frames of one piece of a clip.

    Attributes:
        points: [P, T, 2] pixels, where visible [P, T] bool.
        masks: T of [H, W] uint8, object numbers.
        part: [P, T] int16, the part that a track lies in, from 1, different ones being a gap apart; 0 = in none or not seen.
    """

    points: np.ndarray
    visible: np.ndarray
    masks: list[np.ndarray]
    part: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.part = np.zeros(self.visible.shape, np.int16)
        for k in range(len(self.masks)):
            seen, places = self.find_visible(k)
            self.part[seen, k] = self.parts(k)[1][places[:, 1], places[:, 0]]
        inside = (self.part > 0).sum(1)
        self.part[(inside < SHORTEST) | (inside < INSIDE * self.visible.sum(1))] = 0

    @property
    def long_side(self) -> int:
        """Of the image, in pixels."""
        return max(self.masks[0].shape)

    def find_visible(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Indices [N] of the tracks that are visible in frame k, and the pixels (column, row) [N, 2] that they are on."""
        seen = np.flatnonzero(self.visible[:, k])
        height, width = self.masks[k].shape
        return seen, np.clip(self.points[seen, k].astype(int), 0, [width - 1, height - 1])

    def parts(self, k: int) -> tuple[int, np.ndarray]:
        """One more than how many parts the mask of frame k has, and their labels [H, W], 0 outside the mask."""
        moving = (self.masks[k] > 0).astype(np.uint8)
        side = 2 * max(1, round(GAP * self.long_side)) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        count, labels = cv2.connectedComponents(cv2.dilate(moving, disc))
        return count, labels * moving
