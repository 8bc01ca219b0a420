"""Long clips: cameras of keyframes first, and from their points those of all frames between them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.geometry import Camera
from flowsplat.geometry.cameras import rigid
from flowsplat.geometry.paths import CameraPath
from flowsplat.priors.cameras.bundle import MIN_DEPTH, Reconstruction
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.cameras.refinement import track_errors, with_points

MAX_JOINT_FRAMES = 120
"""Frames up to which all of them are adjusted together (docs/method/cameras.md)."""
MAX_SEARCHED_FRAMES = 48
"""Frames up to which a search for the right start looks at all of them (docs/method/cameras.md)."""
MAX_SEARCH_GAP = 4
"""Frames between two keyframes of a search, at most. Chosen by eye."""
KEYFRAME_OVERLAPS = (0.7, 0.55, 0.4)
"""Share of a keyframe's tracks that the next one must still see; the next value is tried where too many keyframes remain.
Chosen by eye."""
MAX_KEYFRAME_GAP = 16
"""Frames between two keyframes, at most. Chosen by eye."""
MIN_POINTS = 10
"""Points that a frame must see to be placed. Chosen by eye."""
PLACEMENT_STEPS = 8
"""Iterations that place a frame between keyframes. Chosen by eye."""
RESIDUAL_SCALE = 0.5
"""Pixels; residuals beyond it lose their influence. Chosen by eye."""
INLIER_PIXELS = 1.0
"""Pixels by which a point may miss its track to serve other frames. Chosen by eye."""


def choose_keyframes(seen: Observations, most: int = MAX_JOINT_FRAMES, widest: int = MAX_KEYFRAME_GAP) -> np.ndarray:
    """Rising frame numbers, the first and the last among them: all frames of a clip that is not long.

    Args:
        seen: the tracks in all frames.
        most: keyframes, where their overlap allows it.
        widest: frames between two of them, at most.
    """
    count = seen.cameras
    keys = list(range(count))
    tracks = [seen.point[rows] for rows in seen.by_camera()]
    for overlap in KEYFRAME_OVERLAPS:
        if len(keys) <= most:
            break
        keys = [0]
        while keys[-1] < count - 1:
            last = keys[-1]
            here = np.zeros(seen.points, bool)
            here[tracks[last]] = True
            ahead = np.array([here[each].sum() for each in tracks[last + 1 : last + 1 + widest]]) / max(len(tracks[last]), 1)
            keys.append(last + max(1, int(np.argmin(np.append(ahead >= overlap, False)))))
    return np.array(keys)


def place_between(
    keys: np.ndarray, state: Reconstruction, seen: Observations, *, free_translations: bool
) -> tuple[Reconstruction, list[int]]:
    """Poses for all frames from those of the keyframes, and the frames that saw too little and are interpolated.

    Args:
        keys: [K] the keyframes, the first and the last frame among them.
        state: the poses of the keyframes; its points do not count.
        seen: the tracks in all frames, in pixels from the principal point.
    """
    count = seen.cameras
    at_keys = seen.of_cameras(keys)
    often = at_keys.counts >= 2
    seen, at_keys = seen.of_points(often), at_keys.of_points(often)
    state = with_points(state, at_keys, free_translations=free_translations)
    solid = track_errors(state, at_keys) < INLIER_PIXELS
    viewmats = between(keys, state.rotations, state.translations, count)
    viewmats[keys, :3, :3], viewmats[keys, :3, 3] = state.rotations, state.translations
    lost, here = [], seen.where(solid[seen.point])
    rows = here.by_camera()
    for t in np.setdiff1d(np.arange(count), keys):
        tracks = here.point[rows[t]]
        if len(tracks) < MIN_POINTS:
            lost.append(int(t))
            continue
        viewmats[t] = _resect(viewmats[t], state.points[tracks], here.uv[rows[t]], state.focal, free_translations)
    return Reconstruction(viewmats[:, :3, :3], viewmats[:, :3, 3], state.focal, state.points), lost


def between(frames: np.ndarray, rotations: np.ndarray, translations: np.ndarray, count: int) -> np.ndarray:
    """Viewmats [count, 4, 4] interpolated from those of some rising ``frames`` [K]: [K, 3, 3] and [K, 3]."""
    cameras = [Camera(rigid(R, t), np.eye(3), 1, 1) for R, t in zip(rotations, translations, strict=True)]
    path = CameraPath(frames.tolist(), cameras)
    return np.array([path.at(t).viewmat for t in range(count)])


def _resect(viewmat: np.ndarray, points: np.ndarray, uv: np.ndarray, focal: float, free_translations: bool) -> np.ndarray:
    """Return the pose [4, 4] near ``viewmat`` that sees ``points`` [N, 3] at ``uv`` [N, 2]: Gauss-Newton with a Cauchy cost."""
    best, lowest = viewmat, np.inf
    size = 6 if free_translations else 3
    for _ in range(PLACEMENT_STEPS):
        turned = points @ viewmat[:3, :3].T
        p = turned + viewmat[:3, 3]
        a = focal / np.maximum(p[:, 2], MIN_DEPTH)
        r = a[:, None] * p[:, :2] - uv
        square = (r * r).sum(1) / RESIDUAL_SCALE**2
        cost = float(np.log1p(square).sum())
        if not cost < lowest:
            break
        best, lowest = viewmat, cost
        # d uv / d p, then the chain over a small turn w (p changes by w x turned) and a shift.
        D = np.zeros((len(points), 2, 3))
        D[:, 0, 0] = D[:, 1, 1] = a
        D[:, :, 2] = -(a / np.maximum(p[:, 2], MIN_DEPTH))[:, None] * p[:, :2]
        x, y, z = turned.T
        o = np.zeros_like(x)
        cross = np.stack([o, z, -y, -z, o, x, y, -x, o], 1).reshape(-1, 3, 3)
        J = np.concatenate([D @ cross, D], 2)[:, :, :size]
        w = 1 / (1 + square)
        H = np.einsum("n,nki,nkj->ij", w, J, J)
        step = np.zeros(6)
        step[:size] = np.linalg.solve(H + np.diag(1e-9 * np.diag(H) + 1e-12), -np.einsum("n,nki,nk->i", w, J, r))
        viewmat = viewmat.copy()
        viewmat[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ viewmat[:3, :3]
        viewmat[:3, 3] += step[3:]
    return best
