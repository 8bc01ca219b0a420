"""A start for all cameras at once: rotations averaged over many pairs of frames, then all positions together.

Frame after frame, an error once made is carried on; here every pair of frames has its say. Rotations are averaged with
robust weights (Chatterjee and Govindu, "Efficient and robust large-scale rotation averaging", ICCV 2013). With rotations
known, that cameras and points lie on their rays is linear in both; points are eliminated, and the positions are the
smoothest vibration of what remains, reweighted until it measures angles (after Jiang et al., "A global linear method for
camera pose registration", ICCV 2013, and Pan et al., "Global structure-from-motion revisited", ECCV 2024).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.linalg
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from flowsplat.common.kernels import kernel
from flowsplat.priors.cameras.bundle import Reconstruction, adjust
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.refinement import place_points, track_errors
from flowsplat.priors.cameras.twoview import MIN_COMMON_TRACKS, essential, intrinsics

FRAME_STRIDES = (1, 2, 3, 5, 8, 12, 20, 32)
"""Distances in time of the frames that are compared (docs/method/cameras.md)."""
MIN_PURE_TURN_SHARE = 0.9
"""Share of the matches of an epipolar geometry that a mere turn must explain, so that the turn is taken. Chosen by eye."""
MAX_TURN_ERROR = 1.5
"""Pixels by which matches may miss a turn and still follow it. Chosen by eye."""
ROTATION_SCALE = np.radians(0.5)
"""Disagreement between two rotations from which a pair loses its influence. Chosen by eye."""
RAY_SCALE = 0.01
"""Radians by which a ray may miss its point before it loses its influence. Chosen by eye."""
AVERAGING_ROUNDS = 12
"""Rounds of reweighting of the averaged rotations. Chosen by eye."""
COARSE_SCALES = (8.0, 3.0)
"""Scales of the Cauchy cost, in pixels, of the first adjustments: averaged rotations are off by a few pixels. Chosen by eye."""


@dataclass(frozen=True)
class Turn:
    """The rotation [3, 3] from frame ``i`` to frame ``j``, and how many matches speak for it."""

    i: int
    j: int
    rotation: np.ndarray
    weight: float


def start_by_averaging(positions: np.ndarray, seen: np.ndarray, focal: float) -> tuple[Reconstruction, np.ndarray] | None:
    """Return all cameras without a first pair; the frames that were reached [T] bool. None where too few hang together.

    Args:
        positions: [N, T, 2] pixels from the principal point.
        seen: [N, T].
        focal: pixels, a guess.
    """
    count = seen.shape[1]
    turns = pair_rotations(positions, seen, focal)
    rotations, reached = average_rotations(turns, count)
    frames = np.flatnonzero(reached)
    if len(frames) < 2:
        return None
    views = seen[:, frames]
    often = views.sum(1) >= 2
    if often.sum() < MIN_COMMON_TRACKS:
        return None
    pixels, views = positions[np.ix_(often, frames)], views[often]
    centers = position_cameras(rotations[frames], pixels, views, focal)
    translations = -np.einsum("tij,tj->ti", rotations[frames], centers)
    state = Reconstruction(rotations[frames], translations, focal, np.zeros((len(views), 3)))
    for scale in COARSE_SCALES:
        state = _adjust(state, pixels, views, scale)
    turned, moved = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    turned[frames], moved[frames] = state.rotations, state.translations
    return Reconstruction(turned, moved, focal, np.zeros((len(seen), 3))), reached


def _adjust(state: Reconstruction, positions: np.ndarray, seen: np.ndarray, scale: float) -> Reconstruction:
    """Poses after a coarse adjustment to the better tracks."""
    observed = Observations.of(positions, seen)
    points = place_points(state, observed)
    placed = Reconstruction(state.rotations, state.translations, state.focal, points)
    errors = track_errors(placed, observed)
    good = np.isfinite(errors) & (np.argsort(np.argsort(errors)) < 0.7 * len(errors))
    good |= errors <= 3 * scale
    start = Reconstruction(state.rotations, state.translations, state.focal, points[good])
    done = adjust(
        start, observed.of_points(good), iterations=15, scale=scale, fixed_camera=0, free_focal=False, tolerance=1e-3,
    )  # fmt: skip
    return done.reconstruction


def pair_rotations(positions: np.ndarray, seen: np.ndarray, focal: float) -> list[Turn]:
    """Return rotations between frames at all distances of ``FRAME_STRIDES`` that share enough tracks."""
    count = seen.shape[1]
    turns = []
    for stride in FRAME_STRIDES:
        for i in range(count - stride):
            both = seen[:, i] & seen[:, i + stride]
            if both.sum() >= MIN_COMMON_TRACKS:
                turn = _pair_rotation(positions[both, i].astype(float), positions[both, i + stride].astype(float), focal)
                if turn is not None:
                    turns.append(Turn(i, i + stride, *turn))
    return turns


def _pair_rotation(a: np.ndarray, b: np.ndarray, focal: float) -> tuple[np.ndarray, float] | None:
    turn = _mere_turn(a, b, focal)
    rays = np.concatenate([a / focal, np.ones((len(a), 1))], 1) @ turn.T
    follows = np.linalg.norm(rays[:, :2] / np.maximum(rays[:, 2:], 1e-6) * focal - b, axis=1) < MAX_TURN_ERROR
    found = essential(a, b, focal)
    if found is None or found[1].sum() < MIN_COMMON_TRACKS // 2:
        return (turn, float(follows.mean())) if follows.mean() > 0.5 else None
    matrix, inliers = found
    if follows.sum() >= MIN_PURE_TURN_SHARE * inliers.sum():
        return turn, float(follows.mean())
    _, rotation, _, front = cv2.recoverPose(matrix, a[inliers], b[inliers], intrinsics(focal))
    return rotation, float((front > 0).sum()) / len(a)


def _mere_turn(a: np.ndarray, b: np.ndarray, focal: float) -> np.ndarray:
    """Return the rotation [3, 3] that explains the matches without a translation: Kabsch's method with Cauchy weights."""
    u, v = (np.concatenate([p / focal, np.ones((len(p), 1))], 1) for p in (a, b))
    u, v = (r / np.linalg.norm(r, axis=1, keepdims=True) for r in (u, v))
    weights = np.ones(len(u))
    rotation = np.eye(3)
    for _ in range(8):
        U, _, Vt = np.linalg.svd((v * weights[:, None]).T @ u)
        rotation = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        miss = np.linalg.norm(u @ rotation.T - v, axis=1) * focal
        weights = 1 / (1 + (miss / max(MAX_TURN_ERROR, float(np.median(miss)))) ** 2)
    return rotation


def average_rotations(turns: list[Turn], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations [T, 3, 3] world to camera that agree best with the pairs, and the frames that they join [T] bool.

    The largest set of frames that hang together is solved; the others keep the identity.
    """
    rotations, reached = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, bool)
    if not turns:
        return rotations, reached
    i, j = np.array([t.i for t in turns]), np.array([t.j for t in turns])
    between, weight = np.array([t.rotation for t in turns]), np.array([t.weight for t in turns])
    # Short distances first where pairs are equally sure.
    tree = minimum_spanning_tree(coo_array((2.0 - weight + 1e-3 * (j - i), (i, j)), shape=(count, count)))
    known = {(t.i, t.j): t.rotation for t in turns}
    root = int(np.bincount(np.concatenate([i, j]), minlength=count).argmax())
    order, parents = breadth_first_order(tree, root, directed=False)
    reached[order] = True
    for t in order[1:]:
        s = int(parents[t])
        rotations[t] = (known[s, t] if (s, t) in known else known[t, s].T) @ rotations[s]
    used = reached[i] & reached[j]
    i, j, between, weight = i[used], j[used], between[used], weight[used]
    for _ in range(AVERAGING_ROUNDS):
        # R_j ~ B R_i: the error, as a turn in the axes of camera j.
        error = Rotation.from_matrix(between @ rotations[i] @ rotations[j].transpose(0, 2, 1)).as_rotvec()
        scale = max(ROTATION_SCALE, float(np.median(np.linalg.norm(error, axis=1))))
        w = weight / (1 + (error**2).sum(1) / scale**2) ** 2
        H, g = np.zeros((count, count, 3, 3)), np.zeros((count, 3))
        # A turn x_i of camera i appears in camera j as between @ x_i.
        np.add.at(H, (j, j), w[:, None, None] * np.eye(3))
        np.add.at(H, (i, i), w[:, None, None] * np.eye(3))
        np.add.at(H, (j, i), -w[:, None, None] * between)
        np.add.at(H, (i, j), -w[:, None, None] * between.transpose(0, 2, 1))
        np.add.at(g, j, w[:, None] * error)
        np.add.at(g, i, -w[:, None] * np.einsum("mji,mj->mi", between, error))
        A = H.transpose(0, 2, 1, 3).reshape(3 * count, 3 * count) + 1e-9 * np.eye(3 * count)
        fixed = slice(3 * root, 3 * root + 3)
        A[fixed, fixed] += 1e6 * np.eye(3)
        step = np.linalg.solve(A, g.ravel()).reshape(count, 3)
        rotations = Rotation.from_rotvec(step).as_matrix() @ rotations
        if np.abs(step[reached]).max() < 1e-7:
            break
    return rotations, reached


def position_cameras(rotations: np.ndarray, positions: np.ndarray, seen: np.ndarray, focal: float) -> np.ndarray:
    """Centers [T, 3] of cameras with known rotations, their mean at the origin and their spread 1.

    The sum over all observations of the squared distance between a point and its ray, divided by the squared depth, is
    smallest for them. Every track counts the same for its length, and what stays far from its rays loses its weight.
    """
    point, camera = map(np.ascontiguousarray, np.nonzero(seen))
    rays = np.concatenate([positions[point, camera] / focal, np.ones((len(point), 1))], 1)
    rays = np.einsum("mji,mj->mi", rotations[camera], rays / np.linalg.norm(rays, axis=1, keepdims=True))
    weights = np.ones(len(point))
    centers = np.zeros((len(rotations), 3))
    for _ in range(AVERAGING_ROUNDS):
        A, inverse = _ray_equations(rays, weights, camera, point, len(rotations), len(seen))
        _, vectors = scipy.linalg.eigh(A, subset_by_index=[0, 3])
        centers = _without_mean(vectors)
        points = _nearest_to_rays(inverse, rays, weights, camera, point, centers)
        depth = np.einsum("mi,mi->m", points[point] - centers[camera], rays)
        if np.sum(np.sign(depth) * np.minimum(weights, np.median(weights))) < 0:
            centers, points, depth = -centers, -points, -depth
        off = np.linalg.norm(points[point] - centers[camera] - depth[:, None] * rays, axis=1)
        far = np.linalg.norm(points[point] - centers[camera], axis=1)
        typical = float(np.median(far))
        far = np.clip(far, 0.1 * typical, 10 * typical)
        angle = np.where(depth > 0, off / far, np.pi)
        scale = max(RAY_SCALE / 10, min(RAY_SCALE, 2 * float(np.median(angle))))
        weights = (typical / far) ** 2 / (1 + (angle / scale) ** 2)
        weights = np.where(depth > 0, weights, 1e-3 * weights) + 1e-9
    return centers


@kernel
def _ray_equations(rays, weights, camera, point, cameras, points):
    """The quadratic form [3 T, 3 T] of the centers with the points eliminated, and the inverses [N, 3, 3] of the latter."""
    A = np.zeros((3 * cameras, 3 * cameras))
    sums = np.zeros((points, 3, 3))
    blocks = np.zeros((len(point), 3, 3))
    for m in range(len(point)):
        for i in range(3):
            for j in range(3):
                blocks[m, i, j] = weights[m] * ((1.0 if i == j else 0.0) - rays[m, i] * rays[m, j])
                sums[point[m], i, j] += blocks[m, i, j]
                A[3 * camera[m] + i, 3 * camera[m] + j] += blocks[m, i, j]
    inverse = np.zeros((points, 3, 3))
    for n in range(points):
        trace = sums[n, 0, 0] + sums[n, 1, 1] + sums[n, 2, 2]
        if trace > 0:
            for i in range(3):
                sums[n, i, i] += 1e-9 * trace
            inverse[n] = np.linalg.inv(sums[n])
    first = 0
    while first < len(point):
        last = first
        while last < len(point) and point[last] == point[first]:
            last += 1
        for a in range(first, last):
            left = blocks[a] @ inverse[point[first]]
            for b in range(first, last):
                both = left @ blocks[b]
                for i in range(3):
                    for j in range(3):
                        A[3 * camera[a] + i, 3 * camera[b] + j] -= both[i, j]
        first = last
    return A, inverse


@kernel
def _nearest_to_rays(inverse, rays, weights, camera, point, centers):
    """Points [N, 3] with the least weighted distance to their rays."""
    right = np.zeros((len(inverse), 3))
    for m in range(len(point)):
        c = centers[camera[m]]
        along = rays[m, 0] * c[0] + rays[m, 1] * c[1] + rays[m, 2] * c[2]
        for i in range(3):
            right[point[m], i] += weights[m] * (c[i] - rays[m, i] * along)
    points = np.zeros_like(right)
    for n in range(len(inverse)):
        points[n] = inverse[n] @ right[n]
    return points


def _without_mean(vectors: np.ndarray) -> np.ndarray:
    """Centers [T, 3] of spread 1: of the four lowest vibrations [3 T, 4] the one that is no common translation."""
    paths = vectors.T.reshape(4, -1, 3)
    paths = paths - paths.mean(1, keepdims=True)
    # The lowest four span the translations and the path; without their means only the path is left.
    return np.linalg.svd(paths.reshape(4, -1), full_matrices=False)[2][0].reshape(-1, 3)
