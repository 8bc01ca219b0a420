"""Points followed over every frame of the clip, for the camera stage alone (held-out frames are among them)."""

from __future__ import annotations

import cv2
import numpy as np

from flowsplat.common.progress import track
from flowsplat.geometry.interpolation import sample_map
from flowsplat.images.blank import is_blank
from flowsplat.priors.cameras.observations import Observations
from flowsplat.priors.flow import dis_flow, gray
from flowsplat.priors.tracks import TrackTable, corner_strength, new_points, oldest_of_crowds, refine_points
from flowsplat.priors.tracks.patches import Patches, align
from flowsplat.scenes import Scene

WORKING_SIDE = 854
"""Pixels of the longer side at which points are followed; larger images are reduced. Chosen by eye."""
POINTS_AT_A_TIME = 2000
"""About how many points are followed at a time. Chosen by eye."""
MIN_FLOW_SIDE = 100
"""Pixels of the shorter side down to which images are halved for the flow that predicts where points went. Chosen by eye."""
PATCH_SIDE = 15
"""Side of the square of pixels that is compared round a point: large, because precision decides (docs/method/cameras.md)."""
MIN_SIMILARITY = 0.6
"""Structural similarity from which a point's surroundings are still those of the frame that they were cut from. Chosen by eye."""
MAX_DISAGREEMENT = 1.0
"""Pixels between both answers, from frame to frame and from those surroundings, up to which they are the same. Chosen by eye."""
MAX_PATCH_AGE = 20
"""Frames after which a point's surroundings are cut anew (docs/method/cameras.md)."""


class _Surroundings:
    """What is round each point in the frame in which it was first seen, or in one of the last ``MAX_PATCH_AGE`` frames.

    Errors of a point that is followed from frame to frame add up: on rendered clips its median error grows from .03 pixels after
    one frame to .24 after thirty. Compared with the same image each time it stays below .1, and the focal length, which small
    and smooth errors look like, is right.
    """

    def __init__(self) -> None:
        self._patches = _cut_patches(np.zeros((1, 1), np.float32), np.zeros((0, 2), np.float32))
        self._shapes, self._since = np.zeros((0, 2, 2), np.float32), np.zeros(0, int)

    def keep(self, rows: np.ndarray) -> None:
        """Forget all points but those of ``rows``."""
        self._patches, self._shapes, self._since = self._patches[rows], self._shapes[rows], self._since[rows]

    def add(self, image: np.ndarray, points: np.ndarray, t: int) -> None:
        """Remember new points [N, 2] of frame ``t``, gray [H, W] float32."""
        self._patches = self._patches.join(_cut_patches(image, points))
        self._shapes = np.concatenate([self._shapes, np.tile(np.eye(2, dtype=np.float32), (len(points), 1, 1))])
        self._since = np.concatenate([self._since, np.full(len(points), t)])

    def find(self, image: np.ndarray, points: np.ndarray, t: int) -> np.ndarray:
        """Return points [N, 2] of frame ``t`` where their surroundings are the same as before, else where they were."""
        found, shapes, alike = align(self._patches, image, points - np.float32(0.5), self._shapes)
        found += np.float32(0.5)
        same = (alike > MIN_SIMILARITY) & (np.linalg.norm(found - points, axis=1) < MAX_DISAGREEMENT)
        points = np.where(same[:, None], found, points)
        self._shapes[same] = shapes[same]
        old = np.flatnonzero(~same | (t - self._since >= MAX_PATCH_AGE))
        self._patches.replace(old, _cut_patches(image, points[old]))
        self._shapes[old], self._since[old] = np.eye(2), t
        return points


def _cut_patches(image: np.ndarray, points: np.ndarray) -> Patches:
    return Patches.cut(image, np.zeros(image.shape, np.uint8), points - np.float32(0.5))


def follow_points(scene: Scene) -> tuple[Observations, list[int]]:
    """Follow points from frame to frame, across frames that show nothing.

    Returns:
        where points were seen, float32 in pixels of the frames (centers at +0.5); and the blank frames.
    """
    factor = min(1.0, WORKING_SIDE / max(scene.width, scene.height))
    size = (max(1, round(scene.width * factor)), max(1, round(scene.height * factor)))
    to_frame = np.array([scene.width / size[0], scene.height / size[1]], np.float32)
    spacing = max(4, round((size[0] * size[1] / POINTS_AT_A_TIME) ** 0.5))
    table = TrackTable()
    numbers, points = np.zeros(0, int), np.zeros((0, 2), np.float32)
    around = _Surroundings()
    before: np.ndarray | None = None
    blank = []
    for t in track(range(scene.num_frames), "Following points"):
        image = gray(scene.any_frame(t))
        if is_blank(image):
            blank.append(t)
            continue
        if size != (scene.width, scene.height):
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if before is not None:
            expected = points + coarse_flow(before, image, points)
            points, ok = refine_points(before, image, points, expected, PATCH_SIDE)
            numbers, points = numbers[ok], points[ok]
            oldest = oldest_of_crowds(points, 0.6 * spacing)
            numbers, points = numbers[oldest], points[oldest]
            around.keep(np.flatnonzero(ok)[oldest])
            points = around.find(image.astype(np.float32), points, t)
        fresh = new_points(corner_strength(image), points, spacing)
        numbers, points = np.concatenate([numbers, table.start(len(fresh))]), np.concatenate([points, fresh])
        around.add(image.astype(np.float32), fresh, t)
        table.add(t, numbers, points)
        before = image
    frame, track_number, values = table.list_all()
    return Observations(frame, track_number, values * to_frame, table.count, scene.num_frames), blank


def coarse_flow(before: np.ndarray, image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return [N, 2] displacements of ``points``, right to about a pixel: where the refinement begins."""
    if min(image.shape) < 2 * MIN_FLOW_SIDE:
        return sample_map(dis_flow(before, image), points)
    half = (image.shape[1] // 2, image.shape[0] // 2)
    factor = np.array([image.shape[1] / half[0], image.shape[0] / half[1]], np.float32)
    flow = dis_flow(*(cv2.resize(each, half, interpolation=cv2.INTER_AREA) for each in (before, image)))
    return sample_map(flow, points / factor) * factor
