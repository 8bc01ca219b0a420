"""Measure what the protocol of DyCheck asks for: images where the clip saw what they show, and how points are carried along.

DyCheck: Monocular Dynamic View Synthesis: A Reality Check, https://arxiv.org/abs/2210.13445, section 4. mLPIPS is not measured: our
LPIPS has no masks.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import read_json
from flowsplat.evaluation.baselines import to_float
from flowsplat.evaluation.metrics import compute_masked_ssim, psnr
from flowsplat.evaluation.placement import view_camera
from flowsplat.evaluation.scores import mean_of
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.tracking import follow_points
from flowsplat.scenes import Scene
from flowsplat.scenes.formats.nerfies import list_training_names, read_camera

PCK_TOLERANCE = 0.05
"""Of the longer side of the image: a point that is carried closer to where it was marked is right, as in DyCheck."""
KEYPOINT_FACTORS = (2, 1, 4)
"""How many times smaller the images may be on which points were marked; the first that is there counts."""


def measure_dycheck(model: SceneModel, scene: Scene, source: Path) -> dict[str, Any]:
    """Return the figures of DyCheck.

    Args:
        model: trained.
        scene: with the held-out views.
        source: the folder of the input, with points that people marked, where there are some.

    Returns:
        ``mpsnr`` (dB) and ``mssim`` of the held-out views inside the masks of what the clip saw, means over ``views`` of them, and
        ``pck`` (%), the share of ``transfers`` of marked points from one frame to another that come within ``PCK_TOLERANCE``.
        None each where there is nothing to measure.

    Raises:
        InputError: the marked points are damaged.
    """
    scores = []
    for view in scene.views:
        mask = scene.view_mask(view, "covisible")
        if mask is None:
            continue
        image = np.nan_to_num(model.render(view_camera(scene, view), float(scene.timestamps[view.frame])).color)
        target = to_float(scene.view_image(view))
        scores.append((psnr(image, target, mask), compute_masked_ssim(image, target, mask)))
    pck, transfers = _measure_transfers(model, scene, read_keypoints(source, scene))
    return {
        "mpsnr": mean_of(score[0] for score in scores), "mssim": mean_of(score[1] for score in scores), "views": len(scores),
        "pck": pck, "transfers": transfers,
    }  # fmt: skip


def read_keypoints(source: Path, scene: Scene) -> dict[int, np.ndarray]:
    """Return the marked points by frame, [K, 3] each: u, v in pixels of the scene, and whether it is seen there.

    ``keypoint/<factor>x/train/<frame name>.json`` holds them as K rows of u, v and 0 or 1, the same points in every file.

    Raises:
        InputError: a file is damaged, or has another number of points than the first.
    """
    names = list_training_names(source)
    folder = next((path for f in KEYPOINT_FACTORS if (path := source / f"keypoint/{f}x/train").is_dir()), None)
    if folder is None:
        return {}
    factor = int(folder.parent.name[:-1])
    found: dict[int, np.ndarray] = {}
    for frame, name in enumerate(names):
        path = folder / f"{name}.json"
        if not path.exists() or frame >= scene.num_frames:
            continue
        try:
            points = np.array(read_json(path), float).reshape(-1, 3)
        except (TypeError, ValueError) as error:
            raise InputError(f"{path} must hold rows of u, v and whether the point is seen: {error}.") from error
        if not np.isfinite(points).all() or any(len(points) != len(other) for other in found.values()):
            raise InputError(f"{path} has {len(points)} points, some of them no numbers, or another number than others.")
        scale = factor * scene.width / read_camera(source / "camera" / f"{name}.json").width
        found[frame] = points * [scale, scale, 1]
    return found


def _measure_transfers(model: SceneModel, scene: Scene, marked: dict[int, np.ndarray]) -> tuple[float | None, int]:
    """Return the share in percent of the points that are carried from a frame to another and come near where they were marked; a
    point that is lost is wrong. And how many there were."""
    starts = [(frame, k) for frame, points in marked.items() for k in np.flatnonzero(points[:, 2] > 0).tolist()]
    if len(marked) < 2 or not starts:
        return None, 0
    paths = follow_points(model, scene.cameras, scene.timestamps, np.array([[*marked[frame][k, :2], frame] for frame, k in starts]))
    right = []
    for q, (frame, k) in enumerate(starts):
        for other, points in marked.items():
            if other == frame or points[k, 2] <= 0:
                continue
            place = paths.points[q, other].astype(float)
            pixel, depth = (found[0] for found in scene.cameras[other].project(np.nan_to_num(place)[None]))
            is_seen = bool(np.isfinite(place).all()) and depth > 0
            right.append(is_seen and bool(np.linalg.norm(pixel - points[k, :2]) <= PCK_TOLERANCE * max(scene.width, scene.height)))
    return (100 * float(np.mean(right)) if right else None), len(right)
