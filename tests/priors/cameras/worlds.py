"""Cameras, points and what the cameras see of them, for tests."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.geometry import Camera
from flowsplat.priors.cameras.bundle import Reconstruction

WIDTH, HEIGHT, FOCAL = 640, 360, 500.0


def path(count: int, travel: float = 1.5) -> list[Camera]:
    """A gentle sideways path that also turns."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    cameras = []
    for s in np.linspace(0, 1, count):
        viewmat = np.eye(4)
        viewmat[:3, :3] = Rotation.from_rotvec([0.05 * np.sin(5 * s), -0.25 * s, 0.03 * s]).as_matrix()
        center = travel * np.array([s, 0.1 * np.sin(3 * s), 0.2 * s * s])
        viewmat[:3, 3] = -viewmat[:3, :3] @ center
        cameras.append(Camera(viewmat, K, WIDTH, HEIGHT))
    return cameras


def observed(cameras: list[Camera], points: np.ndarray, noise: float, seed: int = 0) -> np.ndarray:
    """Positions [N, T, 2], NaN outside the image; ``points`` [N, 3] or moving [T, N, 3]."""
    rng = np.random.default_rng(seed)
    positions = np.full((points.shape[-2], len(cameras), 2), np.nan)
    for t, camera in enumerate(cameras):
        uv, depth = camera.project(points if points.ndim == 2 else points[t])
        uv = uv + rng.normal(0, noise, uv.shape)
        inside = (depth > 0) & (uv > 0).all(1) & (uv < [WIDTH, HEIGHT]).all(1)
        positions[inside, t] = uv[inside]
    return positions


def world(count: int, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform([-4, -2, 3], [5, 2, 12], (count, 3))


def state_of(cameras: list[Camera], points: np.ndarray) -> Reconstruction:
    viewmats = np.array([c.viewmat for c in cameras])
    return Reconstruction(viewmats[:, :3, :3], viewmats[:, :3, 3], cameras[0].K[0, 0], points)


def cameras_of(state: Reconstruction) -> list[Camera]:
    K = np.array([[state.focal, 0, WIDTH / 2], [0, state.focal, HEIGHT / 2], [0, 0, 1]])
    cameras = []
    for rotation, translation in zip(state.rotations, state.translations, strict=True):
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, translation
        cameras.append(Camera(viewmat, K, WIDTH, HEIGHT))
    return cameras


def centered(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    seen = np.isfinite(positions[..., 0])
    return np.where(seen[..., None], positions, 0) - [WIDTH / 2, HEIGHT / 2], seen


def bend(positions: np.ndarray, distortion: float) -> np.ndarray:
    """Where a lens with this k1 shows what a pinhole sees at ``positions`` [..., 2]."""
    x = (positions - [WIDTH / 2, HEIGHT / 2]) / FOCAL
    return x * (1 + distortion * (x**2).sum(-1, keepdims=True)) * FOCAL + [WIDTH / 2, HEIGHT / 2]
