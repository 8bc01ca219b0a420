"""Points to follow: where they start, how they are refined from one image to the next, and the table they are noted in."""

from __future__ import annotations

import cv2
import numpy as np

SUBPIXEL_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.005)
"""At most 20 steps, until one is below 0.005 pixel."""
MAX_ROUND_TRIP_ERROR = 0.5
"""Pixels by which a point may miss its start after going there and back. Chosen by eye."""
DETAIL_SIGMA, COARSE_DAMPING = 3.0, 0.7
"""Pixels across which an image is blurred for what is larger than detail, and the share of that which is taken away.
Chosen by eye."""


def detail(image: np.ndarray) -> np.ndarray:
    """Gray [H, W] uint8 with its brightness muted, float32.

    Light and shade stay where they are while a surface turns under them, and would hold its texture back.
    """
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), DETAIL_SIGMA)
    return image - np.float32(COARSE_DAMPING) * (smooth - np.float32(128))


def refine_points(
    a: np.ndarray, b: np.ndarray, points: np.ndarray, guess: np.ndarray, window: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return where ``points`` of gray ``a`` lie in gray ``b``, to a fraction of a pixel.

    Pyramidal Lucas-Kanade (Bouguet 2001) from ``guess`` and back again.

    Args:
        points: [N, 2] pixels (centers at +0.5) in ``a``.
        guess: [N, 2] where they are expected in ``b``, right to within a few pixels.
        window: side of the square of pixels that is compared.

    Returns:
        positions [N, 2] float32 and whether each passed the round trip [N] bool.
    """
    if len(points) == 0:
        return np.zeros((0, 2), np.float32), np.zeros(0, bool)
    start, ahead = (np.ascontiguousarray(p - 0.5, np.float32)[:, None] for p in (points, guess))

    def move(source: np.ndarray, target: np.ndarray, begin: np.ndarray, expected: np.ndarray) -> tuple:
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            source, target, begin, expected.copy(), winSize=(window, window), maxLevel=1, criteria=SUBPIXEL_CRITERIA,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        return found, status[:, 0] > 0

    found, there = move(a, b, start, ahead)
    back, returned = move(b, a, found, start)
    height, width = b.shape
    position = found[:, 0]
    ok = there & returned & (np.linalg.norm((back - start)[:, 0], axis=1) < MAX_ROUND_TRIP_ERROR)
    ok &= np.linalg.norm(position - ahead[:, 0], axis=1) < 4
    ok &= (position > 1).all(1) & (position[:, 0] < width - 2) & (position[:, 1] < height - 2)
    return position + np.float32(0.5), ok


def corner_strength(image: np.ndarray) -> np.ndarray:
    """Return [H, W] float32: the smaller eigenvalue of the structure tensor of gray ``image``; 0 where too weak to follow."""
    strength = cv2.cornerMinEigenVal(image, 7, ksize=3)
    weakest = max(1e-6, 1e-3 * float(np.quantile(strength, 0.98)))
    return np.where(strength > weakest, strength, 0)


def new_points(strength: np.ndarray, existing: np.ndarray, spacing: int) -> np.ndarray:
    """Return the strongest corner of every empty cell, [N, 2] pixels.

    Args:
        strength: [H, W], 0 where no point may start.
        existing: [M, 2] pixels of points that are followed already.
        spacing: side of a cell in pixels.
    """
    height, width = strength.shape
    rows, columns = -(-height // spacing), -(-width // spacing)
    taken = np.zeros((height, width), np.uint8)
    pixel = np.clip(existing.astype(int), 0, [width - 1, height - 1])
    taken[pixel[:, 1], pixel[:, 0]] = 1
    near = cv2.dilate(taken, np.ones((spacing, spacing), np.uint8))  # not across a cell's border from an old one either
    strength = np.where(near > 0, 0, strength)
    padded = np.zeros((rows * spacing, columns * spacing), np.float32)
    padded[:height, :width] = strength
    cells = padded.reshape(rows, spacing, columns, spacing).transpose(0, 2, 1, 3).reshape(rows * columns, -1)
    best = cells.argmax(1)
    usable = cells[np.arange(len(cells)), best] > 0
    cell = pixel // spacing
    usable[cell[:, 1] * columns + cell[:, 0]] = False
    chosen = np.flatnonzero(usable)
    x = chosen % columns * spacing + best[chosen] % spacing
    y = chosen // columns * spacing + best[chosen] // spacing
    return np.stack([x, y], 1).astype(np.float32) + np.float32(0.5)


def oldest_of_crowds(points: np.ndarray, side: float) -> np.ndarray:
    """Return indices of the points [N, 2] (oldest first) that are the first in their square of this side."""
    cells = np.floor(points / side).astype(np.int64)
    _, first = np.unique(cells[:, 1] * 1_000_000 + cells[:, 0], return_index=True)
    return np.sort(first)


class TrackTable:
    """Tracks while they grow: ``columns`` values of numbered points, one frame after the other."""

    def __init__(self, columns: int = 2) -> None:
        self.count = 0
        self._columns = columns
        self._frames: list[tuple[int, np.ndarray, np.ndarray]] = []

    def start(self, number: int) -> np.ndarray:
        """Return numbers [number] of new tracks."""
        self.count += number
        return np.arange(self.count - number, self.count)

    def add(self, frame: int, tracks: np.ndarray, values: np.ndarray) -> None:
        """Note the ``values`` [N, columns] of ``tracks`` [N] in ``frame``: x, y and whatever else."""
        self._frames.append((frame, tracks, values))

    def keep_longest(self, most: int) -> None:
        """Forget all but the ``most`` tracks that were seen most often, and number the others anew, in their order."""
        if self.count <= most:
            return
        seen = np.zeros(self.count, int)
        for _, tracks, _ in self._frames:
            seen[tracks] += 1
        kept = np.sort(np.argsort(-seen, kind="stable")[:most])
        number = np.full(self.count, -1)
        number[kept] = np.arange(most)
        here = [(frame, number[tracks], values) for frame, tracks, values in self._frames]
        self._frames = [(frame, tracks[tracks >= 0], values[tracks >= 0]) for frame, tracks, values in here]
        self.count = most

    def list_all(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return frame [M] and track [M] int64 and the values [M, columns] float32 of all that was noted, ordered by track, then
        by frame."""
        frame = np.concatenate([np.zeros(0, np.int64), *(np.full(len(tracks), frame) for frame, tracks, _ in self._frames)])
        track = np.concatenate([np.zeros(0, np.int64), *(tracks for _, tracks, _ in self._frames)])
        values = np.concatenate([np.zeros((0, self._columns), np.float32), *(values for _, _, values in self._frames)])
        order = np.lexsort((frame, track))
        return frame[order], track[order], values[order].astype(np.float32)

    def values(self, frames: int) -> np.ndarray:
        """Return all values [P, frames, columns] float32, NaN where a track was not seen."""
        result = np.full((self.count, frames, self._columns), np.nan, np.float32)
        for frame, tracks, values in self._frames:
            result[tracks, frame] = values
        return result
