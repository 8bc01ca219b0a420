"""Tracks clustered into objects: what agrees in motion, and what is never apart."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from flowsplat.common.kernels import kernel
from flowsplat.priors.objects.identity.masked_tracks import MaskedTracks
from flowsplat.priors.objects.rigid import TrackObservations, longest, solve_rigid
from flowsplat.priors.objects.shape_offset import place_points

NEIGHBORS, NEIGHBOR_REACH = 8, 0.04
"""Nearest tracks that a track is compared with, and how far they may be, as a share of the long side."""
LAGS = ((1, 0.2), (3, 0.45), (8, 0.6))
"""Frames over which the change of a distance is looked at, and the share of the distance that turning and bending may take."""
AGREE = 1.5
"""Pixels, in an image whose long side is 640 or less, that a distance may change beyond that."""
STRONG = 5
"""Frames that two tracks must share for a strong tie."""
LASTING = 3
"""Frames in different parts from which clusters count as apart."""
NOW_AND_THEN = 0.1
"""Frames apart, as a share of those together, up to which a mask only broke."""
STRAY = 0.1
"""Share of the most tracks that a cluster ever has in a frame below which those in another say nothing: they may have slipped."""
FEWEST_TRACKS, FEWEST_FRAMES = 12, 5
"""Below, a cluster is too small to be an object."""
OUTWEIGHS = 3.0
"""Frames of contact in agreement that one frame apart outweighs."""
BRIDGE, BRIDGED = 0.75, 0.7
"""Share of the neighbors across a gap that must agree in a frame, and of the frames apart in which they do, in one object."""
APART_FRAMES = 24
"""Frames, evenly chosen, in which two clusters that are apart are compared."""
MOTION_FRAMES, EXTRAPOLATED = 3, 0.05
"""Frames over which the motion of two clusters is compared, and the error of one that is extrapolated, as a share of how far."""
RIGID_TRACKS, RIGID_FRAMES, EXPLAINED = 24, 10, 0.85
"""Needed to ask whether one rigid motion explains two clusters, and the share of the observations that it must explain."""
EXPLAINED_TOGETHER = 0.6
"""The same where they are together ``OUTWEIGHS`` times as long as they are apart: tracks on a bare rod slide along it."""
RIGID_GAP = 0.12
"""Share of the long side between clusters up to which that is asked."""
RIGID_TURN, RIGID_DEPTH = 15.0, 4.0
"""Degrees that it must turn, and half widths of the larger one that points of the other may be nearer or farther than it."""
OVERLAP, LONGEST_PAUSE = 2, 6
"""Frames that two clusters may share, and that may pass between them, if one continues the other."""
MAX_CLUSTERS = 60
"""Clusters that are compared with each other in one piece of a clip; the smallest beyond are too small."""


def objects_of_tracks(clip: MaskedTracks, K: np.ndarray | None = None) -> np.ndarray:
    """The object, from 1, that every track is on [P]; 0 for those on none, or on what is too small to know.

    Args:
        K: [3, 3] intrinsics. Without them only what is near may be joined across gaps.
    """
    on = np.flatnonzero((clip.part > 0).any(1))
    owners = np.zeros(len(clip.part), int)
    if len(on) == 0:
        return owners
    points = clip.points[on].astype(np.float32)
    part = np.ascontiguousarray(clip.part[on])
    ties = _Ties.find(points, part, clip.long_side)
    cluster = _cluster(part, ties)
    clusters = _Clusters(points, part, cluster, ties, clip.long_side)
    clusters.join_in_contact()
    clusters.join_over_time()
    clusters.join_never_apart()
    clusters.join_across_gaps(K)
    clusters.join_over_time()
    clusters.attach_small()
    owners[on] = clusters.numbers()
    return owners


@dataclass(frozen=True)
class _Ties:
    """Pairs of neighbors, the strongest first.

    Attributes:
        a, b: [E] indices of tracks.
        known: [E] whether they share enough frames to tell.
        agrees: [E] whether their distance hardly changes over all frames that they share.
        strong: how many, the first ones, are known to agree.
    """

    a: np.ndarray
    b: np.ndarray
    known: np.ndarray
    agrees: np.ndarray
    strong: int

    @staticmethod
    def find(points: np.ndarray, part: np.ndarray, long_side: int) -> _Ties:
        found = []
        for k in range(part.shape[1]):
            here = np.flatnonzero(part[:, k])
            count = min(NEIGHBORS + 1, len(here))
            if count < 2:
                continue
            _, near = cKDTree(points[here, k]).query(points[here, k], k=count, distance_upper_bound=NEIGHBOR_REACH * long_side)
            near = np.append(here, -1)[near]
            pairs = np.stack([np.repeat(here, count - 1), near[:, 1:].ravel()], 1)
            pairs = np.sort(pairs[(pairs >= 0).all(1) & (pairs[:, 0] != pairs[:, 1])], 1)
            found.append(pairs[:, 0].astype(np.int64) * len(part) + pairs[:, 1])
        codes = np.unique(np.concatenate(found)) if found else np.zeros(0, np.int64)
        a, b = codes // len(part), codes % len(part)
        worst, shared = _disagreement(points, part > 0, a, b)
        agrees = worst <= AGREE * max(1.0, long_side / 640)
        known = shared >= STRONG
        strong = agrees & known
        order = np.lexsort((worst, -shared, ~agrees, ~strong))
        return _Ties(a[order], b[order], known[order], agrees[order], int(strong.sum()))


class _Clusters:
    """Clusters of tracks, and for how many frames they were together, apart, and in contact."""

    def __init__(self, points: np.ndarray, part: np.ndarray, cluster: np.ndarray, ties: _Ties, long_side: int):
        self._points, self._part, self._long_side = points, part, long_side
        self._ties = ties
        self._scale = max(1.0, long_side / 640)
        _, cluster = np.unique(cluster, return_inverse=True)
        sizes = np.bincount(cluster)
        lasting = np.array([np.count_nonzero((part[cluster == c] > 0).any(0)) for c in range(len(sizes))])
        large = np.flatnonzero((sizes >= FEWEST_TRACKS) & (lasting >= FEWEST_FRAMES))
        large = large[np.argsort(-sizes[large], kind="stable")][:MAX_CLUSTERS]
        rank = np.full(len(sizes), -1)
        rank[large] = np.arange(len(large))
        self._small = cluster
        self._of = rank[cluster]  # [N] the large cluster that a track is in, or -1
        self._count()

    def _count(self) -> None:
        """Where every large cluster mostly is, and the frames in which two of them touch, and agree where they touch."""
        count, frames = int(self._of.max(initial=-1)) + 1, self._part.shape[1]
        self._home = np.array([self._main_part(self._of == c) for c in range(count)], int).reshape(count, frames)
        a, b = self._of[self._ties.a], self._of[self._ties.b]
        across = (a >= 0) & (b >= 0) & (a != b) & self._ties.known
        i, j, agrees = self._ties.a[across], self._ties.b[across], self._ties.agrees[across]
        touching = (self._part[i] == self._part[j]) & (self._part[i] > 0)
        self._touch, self._agree = np.zeros((2, count, count, frames), np.int32)
        pair, frame = np.nonzero(touching)
        for x, y in ((a[across][pair], b[across][pair]), (b[across][pair], a[across][pair])):
            np.add.at(self._touch, (x, y, frame), 1)
            np.add.at(self._agree, (x, y, frame), agrees[pair].astype(np.int32))

    def _main_part(self, chosen: np.ndarray) -> np.ndarray:
        """[T] the part that most of the chosen tracks are in, 0 where none is."""
        parts = self._part[chosen]
        home, most = np.zeros((2, parts.shape[1]), int)
        for k in range(parts.shape[1]):
            held = np.bincount(parts[:, k], minlength=1)
            held[0] = 0
            home[k], most[k] = held.argmax(), held.max()
        return np.where(most > STRAY * most.max(initial=0), home, 0)

    def _join(self, a: int, b: int) -> None:
        """Cluster b becomes part of a; the last one takes its number."""
        last = self._of.max()
        self._of[self._of == b] = a
        if b != last:
            self._of[self._of == last] = b

    def _together(self) -> tuple[np.ndarray, np.ndarray]:
        """Frames [C, C] in which two clusters are in one part, and in different ones."""
        seen = self._home > 0
        both = seen[:, None] & seen[None]
        same = self._home[:, None] == self._home[None]
        return (both & same).sum(2), (both & ~same).sum(2)

    def join_in_contact(self) -> None:
        """Join what agrees where it touches and is hardly ever apart, or agrees for longer than it is apart."""
        while len(self._home) > 1:
            together, apart = self._together()
            contact = self._contact()
            allowed = (contact > 0) & (self._hardly(apart, together) | (contact > OUTWEIGHS * apart))
            if not self._join_best(np.where(allowed, contact - apart + 1e-3 * together, -np.inf)):
                return

    def join_never_apart(self) -> None:
        """Join what shares a part whenever it is seen: limbs, and what is carried."""
        while len(self._home) > 1:
            together, apart = self._together()
            allowed = self._hardly(apart, together) & (together >= LASTING)
            if not self._join_best(np.where(allowed, (self._touch > 0).sum(2) - apart + 1e-3 * together, -np.inf)):
                return

    def join_over_time(self) -> None:
        """Join what begins about where and when another cluster ends: a body whose tracks were all lost at once."""
        while len(self._home) > 1:
            together, apart = self._together()
            allowed = np.maximum(together, apart) <= OVERLAP
            key = np.full(allowed.shape, -np.inf)
            for a, b in np.argwhere(np.triu(allowed, 1)):
                key[a, b] = -self._handover(int(a), int(b))
            if not self._join_best(np.where(key >= -1, key, -np.inf)):
                return

    def _handover(self, a: int, b: int) -> float:
        """How far one of two clusters begins from where the other would be, in units of both their radii; infinite if not then."""
        first, last = np.array([np.flatnonzero(self._home[c])[[0, -1]] for c in (a, b)]).T
        early, late = (0, 1) if first[0] + last[0] <= first[1] + last[1] else (1, 0)
        members = [np.flatnonzero(self._of == c) for c in (a, b)]
        end, start = int(last[early]), int(first[late])
        if abs(start - end) > LONGEST_PAUSE:
            return np.inf
        before, after = self._middle(members[early], end), self._middle(members[late], start)
        since = members[early][(self._part[members[early], end] > 0) & (self._part[members[early], end - 1] > 0)]
        if end > 0 and len(since) and start > end:
            moved = np.median(self._points[since, end] - self._points[since, end - 1], 0)
            before += moved * (start - end)
        return float(np.linalg.norm(before - after) / max(self._radius(members[0]) + self._radius(members[1]), 1e-9))

    def _middle(self, members: np.ndarray, k: int) -> np.ndarray:
        """Mean place [2] of those of the tracks that are seen in frame k."""
        return self._points[members[self._part[members, k] > 0], k].mean(0)

    def _radius(self, members: np.ndarray) -> float:
        """Pixels: of a disc with the spread of the tracks, in the frame with the most of them."""
        seen = self._part[members] > 0
        k = int(np.argmax(seen.sum(0)))
        return float(np.sqrt(2) * np.linalg.norm(np.std(self._points[members[seen[:, k]], k], axis=0)))

    def _larger_first(self, a: int, b: int) -> list[np.ndarray]:
        """The tracks of two clusters."""
        return sorted((np.flatnonzero(self._of == c) for c in (a, b)), key=lambda rows: -len(rows))

    def _sizes(self) -> np.ndarray:
        """[C] tracks of every large cluster."""
        return np.bincount(self._of[self._of >= 0], minlength=len(self._home))

    def _contact(self) -> np.ndarray:
        """Frames [C, C] in which two clusters touch, and most of their neighbors agree."""
        return ((self._agree >= 2) & (2 * self._agree >= self._touch)).sum(2)

    @staticmethod
    def _hardly(apart: np.ndarray, together: np.ndarray) -> np.ndarray:
        return apart < np.maximum(LASTING, NOW_AND_THEN * together)

    def _join_best(self, key: np.ndarray) -> bool:
        """Join the pair with the largest key [C, C]; False if none is finite."""
        key = np.where(np.triu(np.ones(key.shape, bool), 1), key, -np.inf)
        a, b = np.unravel_index(int(key.argmax()), key.shape)
        if not np.isfinite(key[a, b]):
            return False
        self._join(int(a), int(b))
        self._count()
        return True

    def join_across_gaps(self, K: np.ndarray | None) -> None:
        """Join clusters that were apart but move as one: near ones by their neighbors, others by one rigid motion."""
        refused: set[tuple[frozenset[int], frozenset[int]]] = set()
        while len(self._home) > 1:
            joined, (_, apart) = False, self._together()
            sizes = self._sizes()
            pairs = [(int(a), int(b)) for a, b in np.argwhere(np.triu(apart >= LASTING, 1))]
            for a, b in sorted(pairs, key=lambda pair: (-min(sizes[pair[0]], sizes[pair[1]]), pair)):
                members = [np.flatnonzero(self._of == c) for c in (a, b)]
                tried = frozenset(members[0].tolist()), frozenset(members[1].tolist())
                if tried in refused:
                    continue
                if self._close(a, b) and self._moves_alike(a, b, K):
                    self._join(min(a, b), max(a, b))
                    self._count()
                    joined = True
                    break
                refused.add(tried)
            if not joined:
                return

    def _apart_frames(self, a: int, b: int) -> np.ndarray:
        """Frames, at most about ``APART_FRAMES`` of them, in which two clusters are in different parts."""
        found = np.flatnonzero((self._home[a] > 0) & (self._home[b] > 0) & (self._home[a] != self._home[b]))
        return found[:: -(-len(found) // APART_FRAMES)] if len(found) else found

    def _gap(self, a: int, b: int, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the tracks of two clusters in frame k: pairs, one for each of b, the nearest first, and how far they are apart."""
        first, second = (np.flatnonzero((self._of == c) & (self._part[:, k] > 0)) for c in (a, b))
        away, near = cKDTree(self._points[first, k]).query(self._points[second, k])
        order = np.argsort(away, kind="stable")
        return first[near[order]], second[order], away[order]

    def _close(self, a: int, b: int) -> bool:
        """Whether the boxes round two clusters come near in any frame in which they are apart."""
        for k in self._apart_frames(a, b):
            places = [self._points[(self._of == c) & (self._part[:, k] > 0), k] for c in (a, b)]
            low, high = np.stack([p.min(0) for p in places]), np.stack([p.max(0) for p in places])
            if (low.max(0) - high.min(0)).max() <= RIGID_GAP * self._long_side:
                return True
        return False

    def _moves_alike(self, a: int, b: int, K: np.ndarray | None) -> bool:
        """Whether two clusters that were apart are one body."""
        return self._is_bridged(a, b) or self._moves_as_one(a, b) or (K is not None and self._one_rigid_motion(a, b, K))

    def _is_bridged(self, a: int, b: int) -> bool:
        """Whether neighbors across the gap between two clusters agree in most frames in which there is one."""
        apart, agree = self._apart_frames(a, b), 0
        for k in apart:
            i, j, away = self._gap(a, b, int(k))
            near = np.flatnonzero(away <= NEIGHBOR_REACH * self._long_side)[:20]
            worst, shared = _disagreement(self._points, self._part > 0, i[near], j[near])
            told = shared >= STRONG
            agree += told.sum() >= 3 and (worst[told] <= AGREE * self._scale).mean() >= BRIDGE
        return agree >= max(LASTING, BRIDGED * len(apart))

    def _moves_as_one(self, a: int, b: int) -> bool:
        """Whether the shift, turn and growth of the larger of two close clusters tell where the other goes: what a post divides."""
        members = self._larger_first(a, b)
        radius = min(self._radius(rows) for rows in members)
        widest = min(max(radius, NEIGHBOR_REACH * self._long_side), RIGID_GAP * self._long_side)
        seen, told, agree = self._part > 0, 0, 0
        for k in self._apart_frames(a, b):
            if k + MOTION_FRAMES >= seen.shape[1]:
                break
            first, second = (rows[seen[rows, k] & seen[rows, k + MOTION_FRAMES]] for rows in members)
            if min(len(first), len(second)) < FEWEST_TRACKS // 2:
                continue
            told += 1
            x, y = self._points[first, k], self._points[first, k + MOTION_FRAMES]
            away = cKDTree(x).query(self._points[second, k])[0]
            if away.min() > widest:
                continue
            found = cv2.estimateAffinePartial2D(x, y, method=cv2.LMEDS)[0]
            if found is None:
                continue
            off = np.linalg.norm(
                self._points[second, k] @ found[:, :2].T + found[:, 2] - self._points[second, k + MOTION_FRAMES], axis=1
            )
            agree += np.median(off) <= AGREE * self._scale + EXTRAPOLATED * np.median(away)
        return told >= LASTING and agree >= BRIDGE * told

    def _one_rigid_motion(self, a: int, b: int, K: np.ndarray) -> bool:
        """Whether the motion of the larger of two clusters explains the points of the other."""
        apart, members = self._apart_frames(a, b), self._larger_first(a, b)
        same = (self._home[a] > 0) & (self._home[a] == self._home[b])
        different = (self._home[a] > 0) & (self._home[b] > 0) & (self._home[a] != self._home[b])
        together = int(same.sum()) >= OUTWEIGHS * int(different.sum())
        if len(members[1]) < RIGID_TRACKS or (len(apart) < RIGID_FRAMES and not together):
            return False
        middle = apart[:: max(1, len(apart) // 5)]
        if np.median([self._gap(a, b, int(k))[2][0] for k in middle]) > RIGID_GAP * self._long_side:
            return False
        seen = self._part > 0
        larger = members[0][longest(seen[members[0]])]
        motion = solve_rigid(TrackObservations.of_tracks(self._points[larger], seen[larger], K).in_pieces())
        # What only shifts explains all that shifts alike, at some depth.
        if motion is None or motion.inliers < EXPLAINED or motion.widest_turn() < RIGID_TURN:
            return False
        # Points of short tracks could be placed to fit any motion.
        other = members[1][seen[members[1]].sum(1) >= RIGID_FRAMES]
        if len(other) < RIGID_TRACKS // 2:
            return False
        observations = TrackObservations.of_tracks(self._points[other], seen[other], K)
        placed, _ = place_points(motion, observations, K)
        shape_offset = np.abs(np.exp(placed.log_depth) - motion.shifts[placed.frame_of, 2])
        return int((shape_offset <= RIGID_DEPTH * motion.size).sum()) >= (
            (EXPLAINED_TOGETHER if together else EXPLAINED) * len(observations.x)
        )

    def attach_small(self) -> None:
        """Give tracks of small clusters to the large one that they are tied to, or share a part with and are never apart from."""
        if len(self._home) == 0:
            return
        seen = self._home > 0
        for small in np.unique(self._small[self._of < 0]):
            mine = self._small == small
            home = self._main_part(mine)
            both = seen & (home > 0)
            together, apart = (both & (self._home == home)).sum(1), (both & (self._home != home)).sum(1)
            tied = np.concatenate([self._of[self._ties.b[mine[self._ties.a]]], self._of[self._ties.a[mine[self._ties.b]]]])
            agrees = np.concatenate([self._ties.agrees[mine[self._ties.a]], self._ties.agrees[mine[self._ties.b]]])
            known = tied >= 0
            ties = np.bincount(tied[known], minlength=len(seen))
            agreeing = np.bincount(tied[known & agrees], minlength=len(seen))
            allowed = self._hardly(apart, together) & (together > 0) | (2 * agreeing > ties) & (agreeing >= 3)
            if allowed.any():
                self._of[mine] = int(np.where(allowed, agreeing + 1e-3 * ties + 1e-6 * together, -1).argmax())

    def numbers(self) -> np.ndarray:
        """[N] number of the cluster of every track from 1; 0 = none."""
        return self._of + 1


def _disagreement(points: np.ndarray, seen: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of pairs of tracks: by how many pixels, beyond what turning takes, their distance changed most [E]; frames they share [E]."""
    worst, shared = np.full(len(a), np.inf), np.zeros(len(a), int)
    for start in range(0, len(a), 20000):
        rows = slice(start, start + 20000)
        apart, both = points[a[rows]] - points[b[rows]], seen[a[rows]] & seen[b[rows]]
        length, most = np.linalg.norm(apart, axis=2), np.full(len(both), -np.inf)
        for lag, share in LAGS:
            if both.shape[1] <= lag:
                continue
            change = np.linalg.norm(apart[:, lag:] - apart[:, :-lag], axis=2)
            change -= share * np.minimum(length[:, lag:], length[:, :-lag])
            most = np.maximum(most, np.where(both[:, lag:] & both[:, :-lag], change, -np.inf).max(1))
        worst[rows], shared[rows] = np.where(np.isfinite(most), most, np.inf), both.sum(1)
    return worst, shared


def _cluster(part: np.ndarray, ties: _Ties) -> np.ndarray:
    """The cluster of every track [N] from its strong ties, the strongest first; none of them was apart within itself."""
    home, held = part.copy(), (part > 0).astype(np.int32)
    return _union(home, held, ties.a[: ties.strong], ties.b[: ties.strong], LASTING, STRAY)


@kernel
def _union(home: np.ndarray, held: np.ndarray, a: np.ndarray, b: np.ndarray, lasting: int, stray: float) -> np.ndarray:
    """Union of tracks along ties, but for those between sets that were in different parts for ``lasting`` frames.

    Args:
        home: [N, T] the part that a set is mostly in, held: [N, T] how many of its tracks are there; both are changed.
    """
    parent, most = np.arange(len(home)), np.ones(len(home), np.int32)
    for e in range(len(a)):
        x, y = a[e], b[e]
        while parent[x] != x:
            parent[x] = parent[parent[x]]
            x = parent[x]
        while parent[y] != y:
            parent[y] = parent[parent[y]]
            y = parent[y]
        if x == y:
            continue
        apart = 0
        for t in range(home.shape[1]):
            told = held[x, t] > stray * most[x] and held[y, t] > stray * most[y]
            apart += told and home[x, t] != home[y, t]
        if apart >= lasting:
            continue
        if y < x:
            x, y = y, x
        parent[y] = x
        for t in range(home.shape[1]):
            if held[x, t] > 0 and held[y, t] > 0 and home[x, t] == home[y, t]:
                held[x, t] += held[y, t]
            elif held[y, t] > held[x, t]:
                home[x, t], held[x, t] = home[y, t], held[y, t]
            most[x] = max(most[x], held[x, t])
    for n in range(len(parent)):
        root = n
        while parent[root] != root:
            root = parent[root]
        parent[n] = root
    return parent
