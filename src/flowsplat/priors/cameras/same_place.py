"""Whether two prepared clips see the same place, and how the coordinates of one follow from those of the other.

Points of the still scene that look alike (SIFT, Lowe, IJCV 2004) and have a known depth in both clips give a similarity by RANSAC.
It is believed where it is found twice: from every second pair of frames, and from the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flowsplat.common.spread import spread
from flowsplat.geometry import Camera, Similarity
from flowsplat.geometry.similarity import align_points
from flowsplat.scenes import Scene

COMPARED_FRAMES = 6
"""Frames of either clip that are compared, each with each. Chosen by eye."""
MAX_FEATURES = 1500
"""SIFT features of a frame, at most. Chosen by eye."""
MAX_RATIO = 0.8
"""Distance to the best match over that to the second best (Lowe's test)."""
OBJECT_BORDER = 5
"""Pixels around what moves that say nothing of the still scene. Chosen by eye."""
MIN_MATCHES = 24
"""Matches of either half from which a similarity is looked for, and inliers that it needs. A chance match of 1,000 random ones by
three points has far fewer. Chosen by eye."""
MAX_PIXEL_SHARE = 0.01
"""Distance, as a share of the long side, up to which a point that was carried over agrees with its match. Chosen by eye."""
REFINEMENT_ROUNDS = 10
"""Rounds of least squares, at most."""
RANSAC_SAMPLES = 600
"""Samples of three matches that are tried: with a fifth of them right, one sample in 125 is. Seeded, so always the same."""


@dataclass(frozen=True)
class SamePlace:
    """How two clips lie to each other.

    Attributes:
        similarity: from the coordinates of the first clip's cameras to those of the second.
        matches: points that agree.
        pixels: median distance of these from where they are seen.
        split_pixels: median distance, over all that agree, between where the similarities of the two halves put a point: how
            sure it is.
    """

    similarity: Similarity
    matches: int
    pixels: float
    split_pixels: float


@dataclass(frozen=True)
class _Points:
    """Features of a frame on the still scene: descriptors [N, 128], points of the world [N, 3], pixels [N, 2]."""

    descriptors: np.ndarray
    points: np.ndarray
    pixels: np.ndarray
    camera: Camera


@dataclass(frozen=True)
class _Matches:
    """Points of both clips that look alike, with the camera and pixel of either: [N, 3], [N, 3, 4], [N, 3, 3], [N, 2] each."""

    points: tuple[np.ndarray, np.ndarray]
    poses: tuple[np.ndarray, np.ndarray]
    intrinsics: tuple[np.ndarray, np.ndarray]
    pixels: tuple[np.ndarray, np.ndarray]

    @staticmethod
    def of(pair: tuple[_Points, _Points], rows: tuple[np.ndarray, np.ndarray]) -> _Matches:
        """Those of some rows of two frames."""
        (a, b), (i, j) = pair, rows
        poses = np.tile(a.camera.viewmat[:3], (len(i), 1, 1)), np.tile(b.camera.viewmat[:3], (len(j), 1, 1))
        intrinsics = np.tile(a.camera.K, (len(i), 1, 1)), np.tile(b.camera.K, (len(j), 1, 1))
        return _Matches((a.points[i], b.points[j]), poses, intrinsics, (a.pixels[i], b.pixels[j]))

    @staticmethod
    def concatenate(*parts: _Matches) -> _Matches:
        """All of them."""

        def both(name: str) -> tuple[np.ndarray, np.ndarray]:
            values = [getattr(part, name) for part in parts]
            return np.concatenate([value[0] for value in values]), np.concatenate([value[1] for value in values])

        return _Matches(both("points"), both("poses"), both("intrinsics"), both("pixels"))

    def depths(self, clip: int) -> np.ndarray:
        """[N] planar depth of a clip's own points."""
        return np.einsum("nj,nj->n", self.poses[clip][:, 2, :3], self.points[clip]) + self.poses[clip][:, 2, 3]

    def distances(self, similarity: Similarity) -> np.ndarray:
        """[N] pixels, the larger of those in both clips, between points that are carried over and where they are seen."""
        there = self._distance(1, similarity.points(self.points[0]))
        back = self._distance(0, similarity.inverse().points(self.points[1]))
        return np.maximum(there, back)

    def _distance(self, clip: int, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(self.project(clip, points) - self.pixels[clip], axis=1)

    def project(self, clip: int, points: np.ndarray) -> np.ndarray:
        """Pixels [N, 2] of points of a clip's world; infinite behind the camera."""
        seen = np.einsum("nij,nj->ni", self.poses[clip][:, :, :3], points) + self.poses[clip][:, :, 3]
        image = np.einsum("nij,nj->ni", self.intrinsics[clip], seen)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(seen[:, 2:] > 0, image[:, :2] / image[:, 2:], np.inf)


def find_same_place(first: Scene, second: Scene) -> SamePlace | None:
    """Return how two prepared clips lie to each other; None where it is not sure that they see the same place.

    Needs cameras and depth of both; depth that is a guess (a camera that does not travel) tells nothing.
    """
    if any((scene.prior("depth") or {}).get("method") == "guess" for scene in (first, second)):
        return None
    seen = [
        [_look(scene, scene.train_frames[k]) for k in spread(len(scene.train_frames), COMPARED_FRAMES)] for scene in (first, second)
    ]
    pairs = [(a, b) for a in seen[0] for b in seen[1]]
    # Halves are of different frames of the second clip. Most clips are of two places: the first half tells it.
    half = _match(pairs[::2])
    halves = half, None if half is None else _match(pairs[1::2])
    limit = MAX_PIXEL_SHARE * max(first.width, first.height, second.width, second.height)
    if halves[0] is None or halves[1] is None:
        return None
    fits = _fit(halves[0], limit), _fit(halves[1], limit)
    if fits[0] is None or fits[1] is None:
        return None
    crossed = halves[0].distances(fits[1]), halves[1].distances(fits[0])
    if min(int((each < limit).sum()) for each in crossed) < MIN_MATCHES:
        return None  # What one half found, the other does not know.
    every = _Matches.concatenate(halves[0], halves[1])
    best = _refine(every, fits[0], limit)
    agreed = every.distances(best) < limit
    put = [every.project(1, fit.points(every.points[0]))[agreed] for fit in (fits[0], fits[1])]
    apart = np.linalg.norm(put[0] - put[1], axis=1)
    return SamePlace(best, int(agreed.sum()), float(np.median(every.distances(best)[agreed])), float(np.median(apart)))


def _look(scene: Scene, i: int) -> _Points:
    """Features of a frame that lie on the still scene and have a trusted depth."""
    depth, camera = scene.depth(i), scene.cameras[i]
    still = depth.trusted.astype(np.uint8)
    if scene.has_mask(i):
        around = np.ones((2 * OBJECT_BORDER + 1, 2 * OBJECT_BORDER + 1), np.uint8)
        still &= (cv2.dilate((scene.mask(i) > 0).astype(np.uint8), around) == 0).astype(np.uint8)
    gray = cv2.cvtColor(scene.frame(i), cv2.COLOR_RGB2GRAY)
    found, descriptors = cv2.SIFT.create(MAX_FEATURES).detectAndCompute(gray, still * 255)
    if descriptors is None:
        return _Points(np.zeros((0, 128), np.float32), np.zeros((0, 3)), np.zeros((0, 2)), camera)
    pixels = np.array([each.pt for each in found], float) + 0.5  # OpenCV counts from the middle of the first pixel.
    x, y = np.clip(pixels.astype(int), 0, (scene.width - 1, scene.height - 1)).T
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(camera.K).T
    points = (rays * depth.depth[y, x, None] - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    return _Points(descriptors, points, pixels, camera)


def _match(pairs: Sequence[tuple[_Points, _Points]]) -> _Matches | None:
    """What looks alike in pairs of frames, each the best match of the other; None of fewer than ``MIN_MATCHES``."""
    parts = []
    for pair in pairs:
        if min(len(each.points) for each in pair) < 2:
            continue
        there, back = (_best(a.descriptors, b.descriptors) for a, b in (pair, pair[::-1]))
        rows = np.flatnonzero((there >= 0) & (back[there] == np.arange(len(there))))
        parts.append(_Matches.of(pair, (rows, there[rows])))
    joined = _Matches.concatenate(*parts) if parts else None
    return joined if joined is not None and len(joined.points[0]) >= MIN_MATCHES else None


def _best(descriptors: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return [N] the index of the one that looks most alike, -1 where another looks almost as much alike."""
    result = np.full(len(descriptors), -1)
    for first, second in cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors, others, k=2):
        if first.distance < MAX_RATIO * second.distance:
            result[first.queryIdx] = first.trainIdx
    return result


def _fit(matches: _Matches, limit: float) -> Similarity | None:
    """Return the similarity that most of them agree with; None of fewer than ``MIN_MATCHES``."""
    rng = np.random.default_rng(0)
    best, most = None, 0
    for _ in range(RANSAC_SAMPLES):
        rows = rng.choice(len(matches.points[0]), 3, replace=False)
        similarity = align_points(matches.points[0][rows], matches.points[1][rows])
        if similarity is None:
            continue
        count = int((matches.distances(similarity) < limit).sum())
        if count > most:
            best, most = similarity, count
    return None if best is None or most < MIN_MATCHES else _refine(matches, best, limit)


def _refine(matches: _Matches, similarity: Similarity, limit: float) -> Similarity:
    """Return the least squares of all that agree, again as long as more of them do."""
    for _ in range(REFINEMENT_ROUNDS):
        agreed = matches.distances(similarity) < limit
        # What is twice as far away has twice as large errors: of depth, and of pixels.
        weights = 1 / matches.depths(1)[agreed] ** 2
        better = align_points(matches.points[0][agreed], matches.points[1][agreed], weights)
        if better is None or (matches.distances(better) < limit).sum() <= agreed.sum():
            break
        similarity = better
    return similarity
