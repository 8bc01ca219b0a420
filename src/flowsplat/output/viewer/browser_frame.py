"""Convert between the coordinates of the scene and those of the browser."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from flowsplat.geometry import Camera, Similarity
from flowsplat.geometry.cameras import rigid

SCENE_DEPTH = 4.0
"""Median depth of the scene in the browser's coordinates: its arrow and letter keys then cross a scene in about two seconds."""


@dataclass(frozen=True)
class Pose:
    """A camera as the browser has it: OpenCV axes, the principal point in the middle.

    Attributes:
        wxyz: [4] unit quaternion, camera to world.
        position: [3] in the browser's coordinates.
        fov: vertical field of view in radians.
    """

    wxyz: np.ndarray
    position: np.ndarray
    fov: float

    @property
    def forward(self) -> np.ndarray:
        """[3] where it looks."""
        return Rotation.from_quat(self.wxyz, scalar_first=True).as_matrix()[:, 2]


class BrowserFrame:
    """The browser's coordinates: the scene, moved and scaled to a median depth of ``SCENE_DEPTH``."""

    def __init__(self, similarity: Similarity):
        """``similarity``: scene to normalized coordinates (median depth 1)."""
        self.from_scene = Similarity(similarity.scale * SCENE_DEPTH, similarity.rotation, similarity.translation * SCENE_DEPTH)
        self.to_scene = self.from_scene.inverse()

    def camera(self, pose: Pose, width: int, height: int) -> Camera:
        """Return the camera of the scene that sees what the browser's camera sees on an image of that size."""
        R = Rotation.from_quat(pose.wxyz, scalar_first=True).inv().as_matrix()
        focal = height / 2 / np.tan(pose.fov / 2)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return self.to_scene.camera(Camera(rigid(R, -R @ pose.position), K, width, height))

    def turn_between(self, base: Pose, pose: Pose) -> tuple[float, float]:
        """Return degrees to the left and up by which ``pose`` is turned from ``base``, as ``turn_aside`` turns cameras."""
        right, down, ahead = Rotation.from_quat(base.wxyz, scalar_first=True).inv().apply(pose.forward)
        return float(np.degrees(np.arctan2(right, ahead))), float(np.degrees(np.arcsin(np.clip(down, -1, 1))))

    def pose(self, camera: Camera) -> Pose:
        """Return the browser's camera that stands where ``camera`` does; a principal point off the middle is lost."""
        there = self.from_scene.camera(camera)
        wxyz = Rotation.from_matrix(there.viewmat[:3, :3].T).as_quat(scalar_first=True)
        return Pose(wxyz, there.center, 2 * float(np.arctan(camera.height / 2 / camera.K[1, 1])))
