"""Pinhole cameras as data, and the NumPy side of projecting with them (the differentiable side is ``projection``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""From OpenCV's axes of a camera to OpenGL's, with y up and z backward, and back."""

MAX_COORDINATE = 1e9
"""Coordinates and focal lengths beyond which nothing is a camera: their squares have to stay exact enough. Chosen by eye."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: OpenCV axes (x right, y down, z forward), center of the top-left pixel at (0.5, 0.5).

    Attributes:
        viewmat: [4, 4] float64, world to camera.
        K: [3, 3] float64, in pixels.
        width: pixels.
        height: pixels.

    Examples:
        >>> K = np.array([[300, 0, 160], [0, 300, 90], [0, 0, 1]])
        >>> camera = flowsplat.Camera(viewmat=np.eye(4), K=K, width=320, height=180)
        >>> camera.project(np.array([0.0, 0.0, 2.0]))[0]
        array([160.,  90.])
        >>> camera.resize(160, 90).intrinsics
        array([150., 150.,  80.,  45.])
    """

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "viewmat", np.asarray(self.viewmat, np.float64).reshape(4, 4))
        object.__setattr__(self, "K", np.asarray(self.K, np.float64).reshape(3, 3))

    @property
    def center(self) -> np.ndarray:
        """[3] the camera's position in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @property
    def intrinsics(self) -> np.ndarray:
        """[4] fx, fy, cx, cy in pixels."""
        return self.K[[0, 1, 0, 1], [0, 1, 2, 2]]

    def pose_from(self, other: Camera) -> np.ndarray:
        """Return [3, 4] rows of the map from the axes of ``other`` to those of this camera."""
        return (self.viewmat @ np.linalg.inv(other.viewmat))[:3]

    @property
    def is_valid(self) -> bool:
        """Whether every number is finite and not absurd, ``viewmat`` has a rotation, no mirror, and its last row, and the image has
        pixels."""
        R = self.viewmat[:3, :3]
        return bool(
            (np.abs(self.viewmat) <= MAX_COORDINATE).all()  # not for NaN
            and (np.abs(self.K) <= MAX_COORDINATE).all()
            and np.abs(self.viewmat[3] - [0, 0, 0, 1]).max() < 1e-6  # the translation of a transposed one stands here
            and np.abs(R @ R.T - np.eye(3)).max() < 1e-3
            and np.linalg.det(R) > 0
            and min(self.width, self.height) >= 1
            and self.K[0, 0] > 0
            and self.K[1, 1] > 0
        )

    def resize(self, width: int, height: int) -> Camera:
        """Return the same camera with another number of pixels."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return Camera(self.viewmat, scale @ self.K, width, height)

    def widen(self, border: int) -> Camera:
        """Return the same camera with ``border`` more pixels on every side."""
        K = self.K + [[0, 0, border], [0, 0, border], [0, 0, 0]]
        return Camera(self.viewmat, K, self.width + 2 * border, self.height + 2 * border)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points [..., 3] to pixels [..., 2] and planar depth [...]. Points behind the camera keep their sign of
        depth."""
        x, y, z = (points @ row[:3] + row[3] for row in self.viewmat[:3])
        safe = np.where(np.abs(z) < 1e-9, 1e-9, z)
        uv = np.empty((*np.shape(z), 2))
        uv[..., 0] = x / safe * self.K[0, 0] + self.K[0, 2]
        uv[..., 1] = y / safe * self.K[1, 1] + self.K[1, 2]
        return uv, z

    def unproject(self, uv: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Unproject pixels [..., 2] with planar depth [...] to world points [..., 3]."""
        p = np.empty((*np.shape(depth), 3))
        p[..., 0] = (uv[..., 0] - self.K[0, 2]) / self.K[0, 0] * depth
        p[..., 1] = (uv[..., 1] - self.K[1, 2]) / self.K[1, 1] * depth
        p[..., 2] = depth
        return (p - self.viewmat[:3, 3]) @ self.viewmat[:3, :3]

    def tensors(self, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> tuple[torch.Tensor, torch.Tensor]:
        """Return (viewmat [4, 4], K [3, 3]) as torch tensors."""
        viewmat, K = torch.as_tensor(self.viewmat, dtype=dtype), torch.as_tensor(self.K, dtype=dtype)
        # Such small copies have left the host's memory when the call returns: the host does not wait for the device.
        return viewmat.to(device, non_blocking=True), K.to(device, non_blocking=True)

    def to_json(self) -> dict[str, Any]:
        """Return the documented form in ``cameras.json`` files."""
        return {"viewmat": self.viewmat.tolist(), "K": self.K.tolist(), "width": self.width, "height": self.height}

    @staticmethod
    def from_json(value: dict[str, Any]) -> Camera:
        """Return the inverse of ``to_json``."""
        return Camera(np.array(value["viewmat"]), np.array(value["K"]), int(value["width"]), int(value["height"]))


def rigid(rotation: np.ndarray, translation: ArrayLike) -> np.ndarray:
    """Return [4, 4] float64 x -> rotation x + translation, from [3, 3] and [3]: a viewmat."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def pixel_grid(width: int, height: int) -> np.ndarray:
    """Return [H, W, 2] float32: the pixel centers (x, y), the first one (0.5, 0.5)."""
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.stack([x, y], -1) + np.float32(0.5)


def unproject_depth(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Return planar depth [H, W] to world points [H, W, 3]."""
    return camera.unproject(pixel_grid(camera.width, camera.height), depth)
