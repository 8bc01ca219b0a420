"""Similarities: one scale, one rotation, one translation; and how two camera paths are aligned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowsplat.geometry.cameras import MAX_COORDINATE, Camera, rigid


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation, with scale > 0."""

    scale: float = 1.0
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def inverse(self) -> Similarity:
        """Return the similarity that undoes this one."""
        return Similarity(1 / self.scale, self.rotation.T, -self.rotation.T @ self.translation / self.scale)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return [..., 3] points moved."""
        return self.scale * points @ self.rotation.T + self.translation

    def camera(self, camera: Camera) -> Camera:
        """Return the camera that sees the moved world exactly as ``camera`` saw the old one (its depths are scaled)."""
        R = camera.viewmat[:3, :3] @ self.rotation.T
        t = self.scale * camera.viewmat[:3, 3] - R @ self.translation
        return Camera(rigid(R, t), camera.K, camera.width, camera.height)

    def to_json(self) -> dict[str, Any]:
        """Plain numbers."""
        return {"scale": self.scale, "rotation": self.rotation.tolist(), "translation": self.translation.tolist()}

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> Similarity:
        """Return the inverse of ``to_json``.

        Raises:
            ValueError: it is none.
            KeyError, TypeError: something is missing or is no number.
        """
        scale, rotation = float(value["scale"]), np.array(value["rotation"], float).reshape(3, 3)
        translation = np.array(value["translation"], float).reshape(3)
        turns = (np.abs(rotation) < 2).all() and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3  # not for NaN
        is_near = 1 / MAX_COORDINATE <= scale <= MAX_COORDINATE and (np.abs(translation) <= MAX_COORDINATE).all()
        if not (is_near and turns and np.linalg.det(rotation) > 0):
            raise ValueError("its similarity is none: it needs a scale above 0, a rotation and a translation")
        return Similarity(scale, rotation, translation)


def align_paths(estimated: Sequence[Camera], true: Sequence[Camera]) -> Similarity:
    """Return the similarity that brings the estimated path onto the true one.

    Rotations first (their chordal mean), then scale and translation by least squares: on a nearly straight path the
    rotation about it cannot be seen from the positions (docs/method/evaluation.md). A path without extent keeps scale
    1.
    """
    M = sum(t.viewmat[:3, :3].T @ e.viewmat[:3, :3] for e, t in zip(estimated, true, strict=True))
    U, _, Vt = np.linalg.svd(M)
    rotation = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    e = np.array([c.center for c in estimated]) @ rotation.T
    t = np.array([c.center for c in true])
    e0, t0 = e - e.mean(0), t - t.mean(0)
    extent = (e0 * e0).sum()
    scale = float((e0 * t0).sum() / extent) if extent > 1e-18 and (e0 * t0).sum() > 0 else 1.0
    return Similarity(scale, rotation, t.mean(0) - scale * e.mean(0))


def align_points(points: np.ndarray, others: np.ndarray, weights: np.ndarray | None = None) -> Similarity | None:
    """Return the similarity that brings points [N, 3] onto others by least squares (Umeyama, PAMI 1991).

    Args:
        points: N of 3 or more.
        others: [N, 3] where each of them is to come.
        weights: [N]; None = all alike.

    Returns:
        None where they have no extent, or the scale is none that coordinates can have.
    """
    w = np.ones(len(points)) if weights is None else weights
    w = w[:, None] / w.sum()
    a, b = (w * points).sum(0), (w * others).sum(0)
    U, S, Vt = np.linalg.svd((w * (others - b)).T @ (points - a))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    extent = float((w * (points - a) ** 2).sum())
    scale = float((S * signs).sum()) / max(extent, 1e-300)
    if extent < 1e-18 or not 1 / MAX_COORDINATE < scale < MAX_COORDINATE:
        return None
    rotation = U @ np.diag(signs) @ Vt
    return Similarity(scale, rotation, b - scale * rotation @ a)


def path_errors(estimated: Sequence[Camera], true: Sequence[Camera]) -> dict[str, float]:
    """Return how far an estimated path is from the true one after ``align_paths``.

    Returns:
        ``path`` (mean position error over the true path's length), ``rotation`` (mean angle, degrees) and ``focal``
        (relative error of the first camera's focal length).
    """
    similarity = align_paths(estimated, true)
    moved = [similarity.camera(c) for c in estimated]
    t = np.array([c.center for c in true])
    distance = np.linalg.norm(np.array([c.center for c in moved]) - t, axis=1).mean()
    length = np.linalg.norm(np.diff(t, axis=0), axis=1).sum()
    cosines = [(np.trace(m.viewmat[:3, :3] @ c.viewmat[:3, :3].T) - 1) / 2 for m, c in zip(moved, true, strict=True)]
    return {
        "path": float(distance / max(length, 1e-12)),
        "rotation": float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean()),
        "focal": float(abs(estimated[0].K[0, 0] / true[0].K[0, 0] - 1)),
    }
