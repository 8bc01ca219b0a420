"""Move the cameras of drawn worlds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.scenes.synthetic.worlds.parts import UP

CameraKind = Literal["arc", "walking", "shaking", "following", "still"]

Views = tuple[np.ndarray, np.ndarray]
"""Centers [T, 3], and rotations [T, 3, 3] from the world to the cameras."""


def look(places: np.ndarray, targets: np.ndarray, roll: np.ndarray | float, turns: np.ndarray | None = None) -> Views:
    """Return cameras [T] that look at points [T, 3]; ``turns`` [T, 3] are small rotations of the camera in its own axes, in
    radians."""
    forward = targets - places
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    R = np.stack([right, np.cross(forward, right), forward], 1)
    own = np.zeros_like(places) if turns is None else turns.copy()
    own[:, 2] += roll
    return places, np.asarray(Rotation.from_rotvec(own).as_matrix()) @ R


def waves(rng: np.random.Generator, low: float, high: float, count: int = 4) -> Callable[[np.ndarray], np.ndarray]:
    """Smooth random motion [T, 3] with frequencies between ``low`` and ``high`` hertz and a standard deviation of 1."""
    rates = 2 * np.pi * np.exp(rng.uniform(np.log(low), np.log(high), (count, 3)))
    phases = rng.uniform(0, 2 * np.pi, (count, 3))
    weights = 1 / rates
    weights = weights * np.sqrt(2 / (weights**2).sum(0))
    return lambda times: np.asarray((weights * np.sin(rates * times[:, None, None] + phases)).sum(1))
