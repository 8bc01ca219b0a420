"""Pairs of tracks, and what tells whether they are on one object: their relative motion, how far apart they are, their colors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

CELL_PIXELS = 7.0
"""Pixels of an image whose long side is 480: about one track is taken in each cell of the image at any time."""
MIN_FRAMES = 6
"""Frames of a track that is taken."""
MAX_TRACKS = 4000
"""Tracks that are taken of a piece of a clip: the square of it is what the multicut needs of memory, 128 MB."""
MIN_NEW_CELLS = 0.5
"""Share of the cells of a track that must not hold another one."""
NEAREST_TRACKS, NEAREST_REACH = 10, 0.06
"""Nearest tracks, in every frame, that a track is compared with, and how far they may be, as a share of the long side."""
RANDOM_TRACKS, RANDOM_REACH, RANDOM_STRIDE = 6, 0.3, 4
"""The same for tracks drawn by chance, in one of ``EVERY`` frames."""
MIN_SHARED_FRAMES = 3
"""Frames in which both tracks of a pair must be seen."""
LAGS = (1, 4, 12)
"""Frames over which velocities are compared."""
PIXELS = 640.0
"""Long side of the image in whose pixels features are counted."""
PLACES_BETWEEN = np.linspace(0, 1, 9)[1:-1]
"""Places on the line between two tracks at which the mask is looked up."""
LOOKS = 5
"""Shared frames in which that is done."""
FEATURES = (
    "velocity over 1 frame", "velocity over 4 frames", "velocity over 12 frames", "extent of the relative path", "distance",
    "shared frames", "color", "share of frames in different parts", "share of the way outside the mask",
)  # fmt: skip
CHUNK = 20000


@dataclass(frozen=True)
class Trajectories:
    """The tracks on masks that are clustered.

    Attributes:
        points: [N, T, 2] float32 pixels.
        part: [N, T] the part of the mask that each is in; 0 = not seen.
        colors: [N, 3] CIE L*a*b*, mean over time.
        masks: [T, H, W] bool.
    """

    points: np.ndarray
    part: np.ndarray
    colors: np.ndarray
    masks: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """[N, T] bool."""
        return self.part > 0

    @property
    def unit(self) -> float:
        """Pixels of the features' image that a pixel is long."""
        return PIXELS / max(self.masks.shape[1:])


def thin_tracks(points: np.ndarray, part: np.ndarray, long_side: int) -> np.ndarray:
    """Which of the tracks are taken: the longest, about one in each cell of the image and frame, indices [N]."""
    seen = part > 0
    cells = (points // (CELL_PIXELS * long_side / 480)).astype(np.int64)
    taken: set[tuple[int, int, int]] = set()
    kept: list[int] = []
    for i in np.argsort(-seen.sum(1), kind="stable"):
        frames = np.flatnonzero(seen[i])
        if len(frames) < MIN_FRAMES or len(kept) == MAX_TRACKS:
            break
        keys = [(t, x, y) for t, (x, y) in zip(frames.tolist(), cells[i, frames].tolist(), strict=True)]
        if sum(key not in taken for key in keys) >= MIN_NEW_CELLS * len(keys):
            kept.append(int(i))
            taken.update(keys)
    return np.sort(np.array(kept, int))


def list_candidate_pairs(tracks: Trajectories) -> np.ndarray:
    """Pairs [E, 2] of tracks that are near each other in any frame, and of some others; each once, the lower index first."""
    points, seen = tracks.points, tracks.seen
    long_side = max(tracks.masks.shape[1:])
    rng = np.random.default_rng(0)
    found = [np.zeros((0, 2), int)]
    for t in range(seen.shape[1]):
        here = np.flatnonzero(seen[:, t])
        if len(here) < 2:
            continue
        places = points[here, t]
        _, near = cKDTree(places).query(
            places, k=min(NEAREST_TRACKS + 1, len(here)), distance_upper_bound=NEAREST_REACH * long_side
        )
        near = np.append(here, -1)[near]
        pairs = np.stack([np.repeat(here, near.shape[1] - 1), near[:, 1:].ravel()], 1)
        found.append(pairs[pairs[:, 1] >= 0])
        if t % RANDOM_STRIDE == 0:
            a, b = np.tile(here, RANDOM_TRACKS), rng.choice(here, len(here) * RANDOM_TRACKS)
            found.append(np.stack([a, b], 1)[np.linalg.norm(points[a, t] - points[b, t], axis=1) < RANDOM_REACH * long_side])
    pairs = np.unique(np.sort(np.concatenate(found), 1), axis=0)
    shared = np.zeros(len(pairs), int)
    for rows in chunks(len(pairs)):
        shared[rows] = (seen[pairs[rows, 0]] & seen[pairs[rows, 1]]).sum(1)
    return pairs[(pairs[:, 0] != pairs[:, 1]) & (shared >= MIN_SHARED_FRAMES)]


def chunks(count: int) -> list[slice]:
    """Slices that hold at most ``CHUNK`` each."""
    return [slice(start, start + CHUNK) for start in range(0, count, CHUNK)]


def compute_pair_features(tracks: Trajectories, pairs: np.ndarray) -> np.ndarray:
    """[E, ``FEATURES``] of pairs that share ``SHARED`` frames or more."""
    result = np.zeros((len(pairs), len(FEATURES)))
    for rows in chunks(len(pairs)):
        result[rows] = _compute_features(tracks, *pairs[rows].T)
    return result


def _compute_features(tracks: Trajectories, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    seen = tracks.seen
    apart, both = (tracks.points[a] - tracks.points[b]) * tracks.unit, seen[a] & seen[b]
    shared = both.sum(1)
    velocities: list[np.ndarray] = []
    for lag in LAGS:
        told = both[:, lag:] & both[:, :-lag]
        most = np.where(told, np.linalg.norm(apart[:, lag:] - apart[:, :-lag], axis=2), -1).max(1, initial=-1)
        velocities.append(np.where(most >= 0, np.log(most.clip(0) + 0.15), velocities[-1] if velocities else 0.0))
    high = np.where(both[..., None], apart, -np.inf).max(1)
    low = np.where(both[..., None], apart, np.inf).min(1)
    distance = np.where(both, np.linalg.norm(apart, axis=2), 0).sum(1) / shared
    different = ((tracks.part[a] != tracks.part[b]) & both).sum(1) / shared
    return np.stack([
        *velocities, np.log(np.linalg.norm(high - low, axis=1) + 0.3), np.log(distance + 2), np.log(shared),
        np.linalg.norm(tracks.colors[a] - tracks.colors[b], axis=1) / 30, different, _measure_outside(tracks, a, b, both),
    ], 1)  # fmt: skip


def _measure_outside(tracks: Trajectories, a: np.ndarray, b: np.ndarray, both: np.ndarray) -> np.ndarray:
    """[E] share of the straight way between two tracks that is outside the mask, the mean over some shared frames."""
    _, height, width = tracks.masks.shape
    rows, total = np.arange(len(a)), np.zeros(len(a))
    order = np.argsort(~both, axis=1, kind="stable")  # the shared frames come first
    shared = both.sum(1)
    for look in range(LOOKS):
        k = order[rows, (2 * look + 1) * shared // (2 * LOOKS)]
        start, end = tracks.points[a, k], tracks.points[b, k]
        way = (start[:, None] + PLACES_BETWEEN[:, None] * (end - start)[:, None]).astype(int)
        x, y = np.clip(way[..., 0], 0, width - 1), np.clip(way[..., 1], 0, height - 1)
        total += 1 - tracks.masks[k[:, None], y, x].mean(1)
    return total / LOOKS
