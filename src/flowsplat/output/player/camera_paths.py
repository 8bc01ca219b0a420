"""Camera paths of the player: the clip's own, and what of the others it cannot but be told: rows of numbers to interpolate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath
from flowsplat.geometry.rotations import rotations_to_quats
from flowsplat.output.videos.amplitudes import DEFAULT_WIDTHS, LoopWidths
from flowsplat.output.videos.options import RenderOptions
from flowsplat.output.videos.paths import PATHS, PathRequest

PATH_SAMPLES = 4
"""Cameras a frame of a path; the player interpolates linearly between them. Chosen by eye."""
LOOP_TIMES = 17
"""Times of the clip at which a loop is sampled; the player interpolates linearly between them. Chosen by eye."""
LOOP_PHASES = 24
"""Cameras of a turn; the player goes through them along cubic curves."""


def camera_paths(
    model: SceneModel,
    times: Sequence[float],
    cameras: Sequence[Camera],
    widths: LoopWidths = DEFAULT_WIDTHS,
) -> dict[str, Any]:
    """Return what the header of the page says about cameras, in the coordinates of the player (normalized).

    Args:
        model: the scene.
        times: [T] seconds of the clip's frames.
        cameras: [T] its cameras, in the coordinates of the scene.
        widths: how far from there the camera may go.

    Returns:
        ``clipPath``: rows as of ``sample_path``. ``reach``: the half-width of loops in radians (``angle``), and how many times as
        far the view can be pulled aside (``pulls``, as ``LoopWidths`` has them). ``paths``: every path of the page's menu with
        ``name``, ``title``, and either ``rows``, likewise, or, of a loop, the ``seconds`` of a turn and ``offsets``
        [times, phases], both at even steps, as of ``sample_offsets``: for one time where they are the same at all.
    """
    clip = CameraPath(times, cameras)
    even = np.linspace(times[0], times[-1], len(times))
    paths: list[dict[str, Any]] = []
    for entry in PATHS.entries():
        path = entry.value
        if not path.is_in_page:
            continue
        is_loop = path.loop_seconds is not None
        moments = np.linspace(times[0], times[-1], LOOP_TIMES) if is_loop else even
        turn = np.linspace(0, 2 * np.pi, LOOP_PHASES if is_loop else len(even), endpoint=False)
        request = PathRequest(
            model, clip, np.repeat(moments, LOOP_PHASES) if is_loop else even, np.tile(turn, LOOP_TIMES) if is_loop else turn,
            (times[-1] - times[0]) / (len(times) - 1), 1 / model.similarity.scale, RenderOptions.stabilize,
            RenderOptions.eye_distance, widths.angle, widths.dolly, None,
        )  # fmt: skip
        found = path.cameras(request)
        about = {"name": entry.name, "title": entry.title[:1].lower() + entry.title[1:]}
        if is_loop:
            paths.append({**about, "seconds": path.loop_seconds, "offsets": sample_offsets(model, found, request.own)})
        else:
            paths.append({**about, "rows": sample_path(model, even.tolist(), found)})
    reach = {"angle": float(np.radians(widths.angle)), "pulls": widths.pulls}
    return {"clipPath": sample_path(model, times, cameras), "paths": paths, "reach": reach}


def sample_path(model: SceneModel, times: Sequence[float], cameras: Sequence[Camera]) -> list[list[float]]:
    """Return rows of clip time, center, rotation world to camera (wxyz), fx, fy, cx, cy."""
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


def sample_offsets(model: SceneModel, cameras: Sequence[Camera], own: Sequence[Camera]) -> list[list[list[float]]]:
    """Return rows of what takes the clip's own cameras to those of a loop [times x phases]: rotation (wxyz), where its center is
    for the clip's camera, factors of fx and fy, shift of cx and cy over fx and fy."""
    rows = []
    for camera, base in zip(map(model.similarity.camera, cameras), map(model.similarity.camera, own), strict=True):
        turn = camera.viewmat[:3, :3] @ base.viewmat[:3, :3].T
        quat = rotations_to_quats(torch.from_numpy(turn)).numpy()
        focal, base_focal = camera.K[[0, 1], [0, 1]], base.K[[0, 1], [0, 1]]
        shift = (camera.K[:2, 2] - base.K[:2, 2]) / base_focal
        place = base.viewmat[:3, :3] @ (camera.center - base.center)
        rows.append([*quat, *place, *(focal / base_focal), *shift])
    offsets = np.array(rows).reshape(LOOP_TIMES, LOOP_PHASES, -1).round(6) + 0.0
    return (offsets[:1] if np.ptp(offsets, axis=0).max() < 1e-5 else offsets).tolist()
