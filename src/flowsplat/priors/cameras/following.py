"""Points followed over every frame of the clip, for the camera stage alone (held-out frames are among them)."""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.common.progress import track
from flowsplat.geometry.interpolation import sample_map
from flowsplat.priors.continuity import is_blank
from flowsplat.priors.flow import dis_flow, grey
from flowsplat.priors.tracks import TrackTable, corner_strength, new_points, oldest_of_crowds, refine_points
from flowsplat.scenes import Scene

WORKING_SIDE = 854
"""Pixels of the longer side at which points are followed; larger pictures are reduced."""
CELLS = 2000
"""About how many points are followed at a time."""
SMALLEST_SIDE = 100
"""Pixels of the shorter side down to which pictures are halved for the flow that predicts where points went."""
WINDOW = 15
"""Side of the square of pixels that is compared round a point: large, because precision decides."""


def follow_points(scene: Scene) -> tuple[np.ndarray, list[int]]:
    """Follow points from frame to frame, across frames that show nothing.

    Returns:
        positions [P, T, 2] float32 in pixels of the frames (centres at +0.5), NaN where not seen; and the blank frames.
    """
    factor = min(1.0, WORKING_SIDE / max(scene.width, scene.height))
    size = (max(1, round(scene.width * factor)), max(1, round(scene.height * factor)))
    to_frame = np.array([scene.width / size[0], scene.height / size[1]], np.float32)
    spacing = max(4, round((size[0] * size[1] / CELLS) ** 0.5))
    table = TrackTable()
    numbers, points = np.zeros(0, int), np.zeros((0, 2), np.float32)
    before: np.ndarray | None = None
    blank = []
    for t in track(range(scene.num_frames), "Following points"):
        image = grey(scene.any_frame(t))
        if is_blank(image):
            blank.append(t)
            continue
        if size != (scene.width, scene.height):
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if before is not None:
            expected = points + _coarse_flow(before, image, points)
            points, ok = refine_points(before, image, points, expected, WINDOW)
            numbers, points = numbers[ok], points[ok]
            oldest = oldest_of_crowds(points, 0.6 * spacing)
            numbers, points = numbers[oldest], points[oldest]
        fresh = new_points(corner_strength(image), points, spacing)
        numbers, points = np.concatenate([numbers, table.start(len(fresh))]), np.concatenate([points, fresh])
        table.add(t, numbers, points)
        before = image
    return table.values(scene.num_frames) * to_frame, blank


def _coarse_flow(before: np.ndarray, image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[N, 2] displacements of ``points``, right to about a pixel: where the refinement begins."""
    if min(image.shape) < 2 * SMALLEST_SIDE:
        return sample_map(dis_flow(before, image), points)
    half = (image.shape[1] // 2, image.shape[0] // 2)
    factor = np.array([image.shape[1] / half[0], image.shape[0] / half[1]], np.float32)
    flow = dis_flow(*(cv2.resize(each, half, interpolation=cv2.INTER_AREA) for each in (before, image)))
    return sample_map(flow, points / factor) * factor
