"""Measure how far the model's tracks in 3D are from the points of a rendered scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from flowsplat.evaluation.placement import true_scale
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.tracking import follow_points
from flowsplat.geometry import Camera
from flowsplat.scenes import Scene

TRACK_SPAN = 12
"""Frames over which a point is followed from the one in which it is asked for. Chosen by eye."""


def track_errors(model: SceneModel, scene: Scene, births: np.ndarray | None = None) -> dict[str, Any] | None:
    """Follow every true point from the pixel where it is seen, and compare its path with the true one.

    Errors are distances over the point's true depth, in percent, both in the axes of the camera of the same time, so that they
    mean the same with estimated cameras (docs/method/evaluation.md); these get one scale for the clip. Compared are
    the ``TRACK_SPAN`` frames after
    the query, or before it where the clip ends sooner and there are more, in which the true point is visible.

    Args:
        births: [P] the frame in which each true point is asked for, negative = not at all; None = its first visible one.

    Returns:
        ``all``, ``moving`` and ``static``, each None without points, else: ``median`` (%) over all samples, ``last`` (%) the
        median at the last frame of the span, ``within_5`` (%) of the samples with an error below 5 %, ``followed`` (%) of
        the samples that have a position at all (the others count as wrong), ``seen`` (%) of them that we call visible, and
        ``points``, how many were asked for. None without true tracks.
    """
    truth = scene.truth
    if truth is None or not truth.has_tracks or not truth.has_cameras:
        return None
    true = truth.tracks
    births = np.where(true.visible.any(1), true.visible.argmax(1), -1) if births is None else births
    asked = np.flatnonzero(births >= 0)
    if not len(asked):
        return None
    pixels = np.array([truth.cameras[births[p]].project(true.points[p, births[p]].astype(float))[0] for p in asked])
    inside = ((pixels >= 0) & (pixels < [scene.width, scene.height])).all(1)
    asked, pixels = asked[inside], pixels[inside]
    births, points, visible, moving = births[asked], true.points[asked].astype(float), true.visible[asked], true.moving[asked]
    paths = follow_points(model, scene.cameras, scene.timestamps, np.column_stack([pixels, births]))
    ours = true_scale(scene) * _in_cameras(paths.points, scene.cameras)
    exact = _in_cameras(points, truth.cameras)
    errors = 100 * np.linalg.norm(ours - exact, axis=-1) / exact[..., 2]
    errors[np.isnan(errors)] = np.inf
    steps = np.arange(scene.num_frames) - births[:, None]
    remaining = scene.num_frames - 1 - births
    steps[(remaining < TRACK_SPAN) & (remaining < births)] *= -1
    counted = (steps > 0) & (steps <= TRACK_SPAN) & visible
    last = counted & (steps == TRACK_SPAN)
    regions = {"all": np.ones(len(moving), bool), "moving": moving, "static": ~moving}
    return {name: _figures(errors, counted, last, paths.visible, part) for name, part in regions.items()}


def _in_cameras(points: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """Return world points [P, T, 3] in the axes of the camera of their time."""
    return np.stack([points[:, i] @ c.viewmat[:3, :3].T + c.viewmat[:3, 3] for i, c in enumerate(cameras)], 1)


def _figures(
    errors: np.ndarray, counted: np.ndarray, last: np.ndarray, seen: np.ndarray, part: np.ndarray
) -> dict[str, float | None] | None:
    samples = errors[part][counted[part]]
    if not len(samples):
        return None
    return {
        "median": _finite(np.median(samples)),
        "last": _finite(np.median(errors[part][last[part]])) if last[part].any() else None,
        "within_5": 100 * float((samples <= 5).mean()),
        "followed": 100 * float(np.isfinite(samples).mean()),
        "seen": 100 * float(seen[part][counted[part]].mean()),
        "points": float(part.sum()),
    }


def _finite(value: float) -> float | None:
    """None where more than half of the samples have no position."""
    return float(value) if np.isfinite(value) else None
