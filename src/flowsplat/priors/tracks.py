"""Points followed through the clip: chained optical flow, refined by the Lucas-Kanade method, checked there and back."""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.common.progress import track
from flowsplat.priors.continuity import Continuity
from flowsplat.priors.flow import grey, sample_map
from flowsplat.scenes import Scene, Tracks
from flowsplat.scenes.layers import TRUSTED

BACKGROUND_POINTS = 700
MOVER_POINTS = 1500
"""About how many points are followed at a time in a picture, and on all its movers."""
SHORTEST = 3
"""Frames that a kept track was seen in."""
WINDOW = 9
"""Side of the square of pixels that is compared round a point of a track: small, because movers are."""
LARGEST_CORRECTION = 2.0
"""Pixels by which the refinement may differ from the flow: more is a jump to something similar nearby."""
STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.005)
"""At most 20 steps, until one is below 0.005 pixel."""
ROUND_TRIP = 0.5
"""Pixels by which a point may miss its start after going there and back."""


def refine_points(
    a: np.ndarray, b: np.ndarray, points: np.ndarray, guess: np.ndarray, window: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where ``points`` of grey ``a`` lie in grey ``b``, to a fraction of a pixel.

    Pyramidal Lucas-Kanade (Bouguet 2001) from ``guess`` and back again.

    Args:
        points: [N, 2] pixels (centres at +0.5) in ``a``.
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
            source, target, begin, expected.copy(), winSize=(window, window), maxLevel=1, criteria=STOP,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        return found, status[:, 0] > 0

    found, there = move(a, b, start, ahead)
    back, returned = move(b, a, found, start)
    height, width = b.shape
    position = found[:, 0]
    ok = there & returned & (np.linalg.norm((back - start)[:, 0], axis=1) < ROUND_TRIP)
    ok &= np.linalg.norm(position - ahead[:, 0], axis=1) < 4
    ok &= (position > 1).all(1) & (position[:, 0] < width - 2) & (position[:, 1] < height - 2)
    return position + np.float32(0.5), ok


def corner_strength(image: np.ndarray) -> np.ndarray:
    """[H, W] float32: the smaller eigenvalue of the structure tensor of grey ``image``; 0 where too weak to follow."""
    strength = cv2.cornerMinEigenVal(image, 7, ksize=3)
    weakest = max(1e-6, 1e-3 * float(np.quantile(strength, 0.98)))
    return np.where(strength > weakest, strength, 0)


def new_points(strength: np.ndarray, existing: np.ndarray, spacing: int) -> np.ndarray:
    """The strongest corner of every empty cell, [N, 2] pixels.

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
    """Indices of the points [N, 2] (oldest first) that are the first in their square of this side."""
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
        """Numbers [number] of new tracks."""
        self.count += number
        return np.arange(self.count - number, self.count)

    def add(self, frame: int, tracks: np.ndarray, values: np.ndarray) -> None:
        """Note the ``values`` [N, columns] of ``tracks`` [N] in ``frame``: x, y and whatever else."""
        self._frames.append((frame, tracks, values))

    def values(self, frames: int) -> np.ndarray:
        """All values [P, frames, columns] float32, NaN where a track was not seen."""
        result = np.full((self.count, frames, self._columns), np.nan, np.float32)
        for frame, tracks, values in self._frames:
            result[tracks, frame] = values
        return result


def tracks_stage(scene: Scene) -> None:
    """Tracks over the training frames along their stored flow; denser on moving objects, where there are masks.

    They end at a cut of the clip and at frames that show nothing.
    """
    frames, continuity = scene.train_frames, Continuity(scene)
    has_masks = scene.prior("masks") is not None
    coarse, fine = _spacings(scene, has_masks)
    table = TrackTable(columns=4)  # x, y, how sure it is, whether it is on a mover
    numbers, points, sure = np.zeros(0, int), np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
    before: tuple[int, np.ndarray] | None = None
    for k, t in enumerate(track(frames, "Tracks")):
        if continuity.is_blank(k) or (k > 0 and not continuity.same_piece(k, k - 1)):
            numbers, points, sure = numbers[:0], points[:0], sure[:0]
            before = None
        if continuity.is_blank(k):
            continue
        image = grey(scene.frame(t))
        mask = scene.mask(t) > 0 if has_masks else np.ones(image.shape, bool)
        if before is not None:
            points, sure = _follow(scene, before, (t, image), points)
            alive = np.flatnonzero(sure >= TRUSTED)
            alive = alive[oldest_of_crowds(points[alive], 0.5 * fine)]
            numbers, points, sure = numbers[alive], points[alive], sure[alive]
        corners = corner_strength(image)
        # On movers every cell gets a point, even where nothing is a corner: the flow carries it.
        for strength, spacing in ((np.where(mask, corners + 1e-12, 0), fine), (np.where(mask, 0, corners), coarse)):
            fresh = new_points(strength, points, spacing)
            numbers, points = np.concatenate([numbers, table.start(len(fresh))]), np.concatenate([points, fresh])
            sure = np.concatenate([sure, np.ones(len(fresh), np.float32)])
        inside = sample_map(mask.astype(np.float32), points)
        table.add(t, numbers, np.concatenate([points, sure[:, None], inside], 1))
        before = (t, image)
    values = table.values(scene.num_frames)
    lengths = np.isfinite(values[..., 0]).sum(1)
    values = values[lengths >= min(SHORTEST, len(frames))]
    visible = np.isfinite(values[..., 0])
    moving = np.nan_to_num(values[..., 3]).sum(1) > 0.5 * visible.sum(1) if has_masks else np.zeros(len(values), bool)
    values = np.nan_to_num(values)
    scene.write_tracks(Tracks(values[..., :2], visible, values[..., 2], moving))
    length = int(np.median(visible.sum(1))) if len(values) else 0
    verdict = f"{len(values)} points, followed over {length} frames (median)" if len(values) else "nothing could be followed"
    if moving.any():
        verdict += f", {moving.sum()} of them on moving objects"
    scene.finish_prior(
        "tracks", method="flow+klt", verdict=verdict, tracks=len(values), moving=int(moving.sum()), median_length=length,
    )  # fmt: skip


def _spacings(scene: Scene, has_masks: bool) -> tuple[int, int]:
    """Pixels between points: on the background and on movers (everything may move where there are no masks)."""
    area = float(scene.width * scene.height)
    mover_area = area
    if has_masks:
        chosen = scene.train_frames[:: max(1, len(scene.train_frames) // 8)]
        areas = [int((scene.mask(t) > 0).sum()) for t in chosen]
        mover_area = float(np.median([a for a in areas if a > 0] or [scene.width * scene.height]))
    coarse = max(3, round((area / BACKGROUND_POINTS) ** 0.5))
    return coarse, int(np.clip(round((mover_area / MOVER_POINTS) ** 0.5), 3, coarse))


def _follow(
    scene: Scene, before: tuple[int, np.ndarray], now: tuple[int, np.ndarray], points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Positions [N, 2] of ``points`` one training frame later, and how sure they are [N] (0 outside the picture)."""
    flow = scene.flow(before[0], now[0])
    carried = points + sample_map(flow.flow, points)
    sure = sample_map(flow.confidence, points)[:, 0]
    refined, ok = refine_points(before[1], now[1], points, carried, WINDOW)
    better = ok & (np.linalg.norm(refined - carried, axis=1) < LARGEST_CORRECTION)
    moved = np.where(better[:, None], refined, carried)
    height, width = now[1].shape
    inside = (moved >= 0).all(1) & (moved[:, 0] <= width) & (moved[:, 1] <= height)
    return moved, np.where(inside, sure, 0).astype(np.float32)
