"""Begin a reconstruction: which two frames see the most depth, and what rotations alone can explain."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

MIN_COMMON_TRACKS = 12
"""Tracks that two frames must share to be a pair. Chosen by eye."""
MIN_PARALLAX = np.radians(3.0)
"""Below this median angle a pair scores less: its depths are uncertain. Chosen by eye."""


@dataclass(frozen=True)
class Pair:
    """Two frames with enough parallax to start from.

    Attributes:
        i, j: the frames.
        score: how many more tracks follow an epipolar geometry than a plane or a rotation, damped where the parallax is
            small.
    """

    i: int
    j: int
    score: float


def intrinsics(focal: float) -> np.ndarray:
    """Return [3, 3] for pixels counted from the principal point."""
    return np.diag([focal, focal, 1.0])


def _common(positions: np.ndarray, seen: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    both = seen[:, i] & seen[:, j]
    return positions[both, i].astype(np.float64), positions[both, j].astype(np.float64)


def essential(a: np.ndarray, b: np.ndarray, focal: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Essential matrix [3, 3] and inliers [N] of matches ``a``, ``b`` [N, 2]; None where there is none."""
    matrix, inliers = cv2.findEssentialMat(a, b, intrinsics(focal), cv2.USAC_MAGSAC, 0.999, 1.0)
    if matrix is None or matrix.shape != (3, 3) or inliers is None:
        return None
    return matrix, inliers[:, 0] > 0


def rank_pairs(positions: np.ndarray, seen: np.ndarray, focal: float) -> list[Pair]:
    """Pairs of frames, best first and one for each distance in time, by how much a translation is needed to explain them.

    Args:
        positions: [N, T, 2] pixels from the principal point.
        seen: [N, T].
        focal: a guess is enough.
    """
    count = positions.shape[1]
    gaps = [gap for gap in (1, 2, 4, 6, 8, 12, 16, 24, 32, 48) if gap < count]
    pairs = []
    for i in range(0, count - 1, max(1, count // 10)):
        for j in (i + gap for gap in gaps if i + gap < count):
            a, b = _common(positions, seen, i, j)
            if len(a) < MIN_COMMON_TRACKS:
                continue
            _, plane = cv2.findHomography(a, b, cv2.RANSAC, 2.0)
            found = essential(a, b, focal)
            if found is not None and plane is not None:
                extra = (int(found[1].sum()) - int(plane.sum())) / np.sqrt(len(a))
                pairs.append(Pair(i, j, float(extra * min(1.0, _parallax(a, b, *found, focal) / MIN_PARALLAX))))
    pairs.sort(key=lambda pair: (-pair.score, pair.i, pair.j))
    best: dict[int, Pair] = {}
    for pair in pairs:
        best.setdefault(pair.j - pair.i, pair)
    return list(best.values())


def _parallax(a: np.ndarray, b: np.ndarray, matrix: np.ndarray, inliers: np.ndarray, focal: float) -> float:
    """Return the median angle in radians between the two rays of a match, once the rotation is undone."""
    if not inliers.any():
        return 0.0
    _, rotation, _, _ = cv2.recoverPose(matrix, a[inliers], b[inliers], intrinsics(focal))
    rays = [np.concatenate([p[inliers] / focal, np.ones((inliers.sum(), 1))], 1) for p in (a, b)]
    u, v = (r / np.linalg.norm(r, axis=1, keepdims=True) for r in (rays[0] @ rotation.T, rays[1]))
    return float(np.median(np.arccos(np.clip((u * v).sum(1), -1, 1))))


def relative_pose(positions: np.ndarray, seen: np.ndarray, pair: Pair, focal: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation [3, 3] and unit translation [3] from the first camera of ``pair`` to the second; None where undefined."""
    a, b = _common(positions, seen, pair.i, pair.j)
    found = essential(a, b, focal)
    if found is None or found[1].sum() < MIN_COMMON_TRACKS // 2:
        return None
    matrix, inliers = found
    _, rotation, translation, _ = cv2.recoverPose(matrix, a[inliers], b[inliers], intrinsics(focal))
    return rotation, translation[:, 0]


def chain_rotations(positions: np.ndarray, seen: np.ndarray, focal: float) -> np.ndarray:
    """Return rotations [T, 3, 3] world to camera, the first the identity, from the homographies between neighbors."""
    count = positions.shape[1]
    rotations = np.tile(np.eye(3), (count, 1, 1))
    K = intrinsics(focal)
    for t in range(1, count):
        a, b = _common(positions, seen, t - 1, t)
        step = np.eye(3)
        if len(a) >= 4:
            plane, _ = cv2.findHomography(a, b, cv2.RANSAC, 1.5)
            if plane is not None:
                U, _, Vt = np.linalg.svd(np.linalg.inv(K) @ plane @ K)
                step = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        rotations[t] = step @ rotations[t - 1]
    return rotations
