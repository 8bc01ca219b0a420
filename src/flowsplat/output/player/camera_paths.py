"""Camera paths of the player: the clip's own, the same without its shaking, and the depth of its subject."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath
from flowsplat.geometry.rotations import rotations_to_quats
from flowsplat.output.videos.options import RenderOptions
from flowsplat.output.videos.shots import subject_distance
from flowsplat.output.videos.stabilized import stabilize

PATH_SAMPLES = 4
"""Cameras a frame of a path; the player interpolates linearly between them. Chosen by eye."""
_SUBJECT_TIMES = 17
"""Times of the clip at which the distance of what moves is looked at. Chosen by eye."""


def camera_paths(model: SceneModel, times: Sequence[float], cameras: Sequence[Camera]) -> dict[str, Any]:
    """Return what the header of the page says about cameras, in the coordinates of the player (normalized).

    Args:
        model: the scene.
        times: [T] seconds of the clip's frames.
        cameras: [T] its cameras, in the coordinates of the scene.

    Returns:
        ``clipPath`` and ``steadyPath``: rows of clip time, center, rotation world to camera (wxyz), fx, fy, cx, cy.
        ``subjectDepths``: planar depth of the objects at even steps of the clip, the median depth of the clip where none are seen.
    """
    step = (times[-1] - times[0]) / (len(times) - 1)
    even, clip = np.linspace(times[0], times[-1], len(times)).tolist(), CameraPath(times, cameras)
    steady, _ = stabilize(model, [(clip.at(t), t) for t in even], RenderOptions.stabilize / step)
    return {
        "clipPath": sample_path(model, times, cameras),
        "steadyPath": sample_path(model, even, [camera for camera, _ in steady]),
        "subjectDepths": _subject_depths(model, times, cameras),
    }


def sample_path(model: SceneModel, times: Sequence[float], cameras: Sequence[Camera]) -> list[list[float]]:
    """Return the rows of a path: see ``camera_paths``."""
    path = CameraPath(times, [model.similarity.camera(camera) for camera in cameras])
    steps = PATH_SAMPLES * (len(times) - 1)
    fine = np.interp(np.arange(steps + 1) / PATH_SAMPLES, np.arange(len(times)), times)
    rows = []
    before = np.array([1.0, 0, 0, 0])
    for t in fine:
        camera = path.at(float(t))
        quat = rotations_to_quats(torch.from_numpy(camera.viewmat[:3, :3].copy())).numpy()
        before = quat if quat @ before >= 0 else -quat
        K = camera.K
        row = [model.clip_time(float(t)), *camera.center, *before, K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        rows.append([round(float(value), 7) for value in row])
    return rows


def _subject_depths(model: SceneModel, times: Sequence[float], cameras: Sequence[Camera]) -> list[float]:
    path, scale = CameraPath(times, cameras), model.similarity.scale
    probes = np.linspace(times[0], times[-1], _SUBJECT_TIMES)
    return [round(scale * subject_distance(model, path.at(float(t)), float(t), 1 / scale), 5) for t in probes]
