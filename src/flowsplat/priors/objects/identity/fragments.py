"""Fragments of tracks, which hardly hold two objects, compared over the whole clip: what single tracks are too short to tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowsplat.priors.objects.identity.pairs import Trajectories, chunks

MIN_TRACKS = 5
"""Tracks of a fragment."""
STRAY_SHARE, STRAY_TRACKS = 0.15, 2
"""Share of the most tracks that a fragment has in a frame, and tracks, below which those in another frame may have slipped."""
MIN_SHARED_FRAMES = 3
"""Frames in which two fragments must be seen to compare their paths; below, one may continue the other."""
MAX_GAP = 120.0
"""Pixels, in an image whose long side is 640, that two fragments may be apart where they are nearest."""
CONTACT_GAP = 10.0
"""The same, from which they count as touching."""
MAX_PAUSE, MAX_HANDOVER = 15, 150.0
"""Frames between two fragments of which one continues the other, and pixels from where it would be."""
VELOCITY_FRAMES = 4
"""Frames before its end from which a fragment is extrapolated."""
TOP_COST_SHARE = 0.2
"""Share of the pairs between two fragments, those with the largest cost, that are looked at by themselves."""
FEATURES = (
    "mean cost of their pairs", "mean cost of the surest pairs", "pairs", "frames together", "share of frames in different parts",
    "mean gap", "largest gap", "smallest gap", "ratio of sizes", "extent of the relative path", "the same by their sizes",
    "velocity over 1 frame", "velocity over 4 frames", "color", "tracks of the smaller", "tracks of the larger", "handover",
    "share of frames in contact", "never together",
)  # fmt: skip


@dataclass(frozen=True)
class Fragments:
    """Where fragments of tracks are, in pixels of an image whose long side is 640.

    Attributes:
        count: [P] tracks of each.
        home: [P, T] the part of the mask that most of its tracks are in; 0 where it is not seen.
        middle, velocity: [P, T, 2] median of its tracks, to the next frame; NaN where unknown.
        radius: [P] of a disc with the spread of its tracks, the largest of all frames.
        color: [P, 3] CIE L*a*b*.
        gap: [T, P, P] float32, distance of the nearest tracks of two fragments, infinite where one is not seen.
    """

    count: np.ndarray
    home: np.ndarray
    middle: np.ndarray
    velocity: np.ndarray
    radius: np.ndarray
    color: np.ndarray
    gap: np.ndarray

    @staticmethod
    def of(tracks: Trajectories, fragment: np.ndarray) -> Fragments:
        """The fragments of tracks [N], those from 0 on."""
        number, frames = int(fragment.max(initial=-1)) + 1, tracks.part.shape[1]
        points, seen = tracks.points * np.float32(tracks.unit), tracks.seen
        home, held = np.zeros((2, number, frames), int)
        middle, velocity = np.full((2, number, frames, 2), np.nan)
        radius = np.zeros(number)
        gap = np.full((frames, number, number), np.inf, np.float32)
        for k in range(frames):
            here = np.flatnonzero(seen[:, k] & (fragment >= 0))
            if len(here) == 0:
                continue
            here = here[np.argsort(fragment[here], kind="stable")]
            shown, start = np.unique(fragment[here], return_index=True)
            away = np.linalg.norm(points[here, k][:, None] - points[here, k][None], axis=2)
            gap[k][np.ix_(shown, shown)] = np.minimum.reduceat(np.minimum.reduceat(away, start, 0), start, 1)
            for p, members in zip(shown, np.split(here, start[1:]), strict=True):
                held[p, k], home[p, k] = len(members), np.bincount(tracks.part[members, k]).argmax()
                middle[p, k] = np.median(points[members, k], 0)
                radius[p] = max(radius[p], np.sqrt(2) * np.linalg.norm(points[members, k].std(0)))
                if k + 1 < frames and seen[members, k + 1].sum() >= STRAY_TRACKS:
                    stays = members[seen[members, k + 1]]
                    velocity[p, k] = np.median(points[stays, k + 1] - points[stays, k], 0)
        home[held < np.maximum(STRAY_TRACKS, STRAY_SHARE * held.max(1, keepdims=True, initial=0))] = 0
        color = np.array([tracks.colors[fragment == p].mean(0) for p in range(number)]).reshape(-1, 3)
        return Fragments(np.bincount(fragment[fragment >= 0], minlength=number), home, middle, velocity, radius, color, gap)

    def predict_handover(self, a: int, b: int) -> float | None:
        """How far the later of two fragments begins from where the earlier one would be, in pixels; None if not soon after."""
        first, second = np.flatnonzero(self.home[a]), np.flatnonzero(self.home[b])
        if len(first) == 0 or len(second) == 0:
            return None
        if first.mean() > second.mean():
            a, b, first, second = b, a, second, first
        start = second[0]
        end = first[first <= max(start, first[0])][-1]
        velocities = self.velocity[a, max(0, end - VELOCITY_FRAMES) : end]
        known = velocities[np.isfinite(velocities).all(1)]
        step = known.mean(0) if len(known) else np.zeros(2)
        off = float(np.linalg.norm(self.middle[a, end] + step * (start - end) - self.middle[b, start]))
        return off if off <= MAX_HANDOVER and abs(start - end) <= MAX_PAUSE else None


def compute_fragment_features(
    tracks: Trajectories, fragment: np.ndarray, pairs: np.ndarray, costs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs [E, 2] of fragments that may be one object, and their ``FEATURES``.

    Args:
        fragment: [N] the fragment of every track, from 0; -1 = none.
        pairs: of tracks, costs: of each.
    """
    fragments = Fragments.of(tracks, fragment)
    number = len(fragments.count)
    a, b = np.triu_indices(number, 1)
    together = np.zeros(len(a), int)
    for rows in chunks(len(a)):
        together[rows] = ((fragments.home[a[rows]] > 0) & (fragments.home[b[rows]] > 0)).sum(1)
    near = fragments.gap.min(0, initial=np.inf)[a, b] <= MAX_GAP
    handover = np.full(len(a), np.nan)
    for e in np.flatnonzero(together < MIN_SHARED_FRAMES):
        off = fragments.predict_handover(int(a[e]), int(b[e]))
        handover[e] = np.nan if off is None else off
    chosen = np.where(together < MIN_SHARED_FRAMES, np.isfinite(handover), near)
    a, b, together, handover = a[chosen], b[chosen], together[chosen], handover[chosen]
    features = np.zeros((len(a), len(FEATURES)))
    for rows in chunks(len(a)):
        features[rows, 4:13] = _measure_paths(fragments, a[rows], b[rows])
        features[rows, 17] = _measure_contact(fragments, a[rows], b[rows])
    mean, surest, count = _average_costs(number, fragment, pairs, costs)
    smaller, larger = np.sort(np.stack([fragments.count[a], fragments.count[b]]), 0)
    features[:, :3] = np.stack([mean[a, b], surest[a, b], count[a, b] / np.maximum(smaller, 1)], 1)
    apart = together < MIN_SHARED_FRAMES
    features[np.ix_(apart, [*range(3), *range(4, 8), *range(9, 13), 17])] = 0
    features[:, 3] = np.log(1 + together)
    features[:, 13] = np.linalg.norm(fragments.color[a] - fragments.color[b], axis=1) / 30
    features[:, 14], features[:, 15] = np.log(np.maximum(smaller, 1)), np.log(np.maximum(larger, 1))
    off = np.log(np.where(apart, handover, 0) + 4) - np.log(fragments.radius[a] + fragments.radius[b] + 4)
    features[:, 16], features[:, 18] = np.where(apart, off, 0), apart
    return np.stack([a, b], 1), features


def _find_shared(fragments: Fragments, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames [E, T] in which both fragments of a pair are seen, and the gap between them, 0 elsewhere."""
    both = (fragments.home[a] > 0) & (fragments.home[b] > 0)
    return both, np.where(both, fragments.gap[:, a, b].T, 0)


def _measure_contact(fragments: Fragments, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    both, gap = _find_shared(fragments, a, b)
    return (both & (gap < CONTACT_GAP)).sum(1) / np.maximum(both.sum(1), 1)


def _measure_paths(fragments: Fragments, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Features 4 to 12 [E, 9] of pairs of fragments that are seen together."""
    both, gap = _find_shared(fragments, a, b)
    count = np.maximum(both.sum(1), 1)
    different = (both & (fragments.home[a] != fragments.home[b])).sum(1) / count
    smallest = np.where(both, gap, np.inf).min(1, initial=1e3)
    relative = fragments.velocity[a] - fragments.velocity[b]
    relative = np.where((np.isfinite(relative).all(2) & both)[..., None], relative, 0)
    path = np.concatenate([np.zeros((len(a), 1, 2)), np.cumsum(relative, 1)], 1)
    extent = np.linalg.norm(path.max(1) - path.min(1), axis=1)
    fast = np.linalg.norm(relative, axis=2).max(1)
    lag = min(VELOCITY_FRAMES, path.shape[1] - 1)
    slow = np.linalg.norm(path[:, lag:] - path[:, :-lag], axis=2).max(1)
    low, high = np.sort(np.stack([fragments.radius[a], fragments.radius[b]]) + 4, 0)
    return np.stack([
        different, np.log(gap.sum(1) / count + 3), np.log(gap.max(1) + 3), np.log(smallest + 3), np.log(low / high),
        np.log(extent + 1), np.log((extent + 1) / (low + high)), np.log(fast + 0.3), np.log(slow + 0.5),
    ], 1)  # fmt: skip


def _average_costs(
    number: int, fragment: np.ndarray, pairs: np.ndarray, costs: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the pairs of tracks between two fragments, the lower one first: mean cost, that of the surest, how many; each [P, P]."""
    mean, surest, count = np.zeros((3, number, number))
    x, y = np.sort(fragment[pairs], 1).T
    between = (x >= 0) & (x != y)
    key, costs = x[between] * number + y[between], costs[between]
    order = np.lexsort((costs, key))
    keys, start = np.unique(key[order], return_index=True)
    for code, found in zip(keys.tolist(), np.split(costs[order], start[1:]), strict=False):
        at = divmod(code, number)
        mean[at], count[at] = found.mean(), len(found)
        surest[at] = found[int((1 - TOP_COST_SHARE) * len(found)) :].mean()
    return mean, surest, count
