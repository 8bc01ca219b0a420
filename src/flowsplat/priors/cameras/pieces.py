"""Pieces of a clip whose frames can be joined by tracks, and the cameras of all of them in one world."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np

from flowsplat.geometry import Camera
from flowsplat.geometry.paths import CameraPath
from flowsplat.priors.cameras.observations import Observations

MIN_SURVIVORS = 0.1
"""Share of points that survive from one frame to the next, below which there is a break. Chosen by eye."""
FEW_SURVIVORS = 0.25
"""The same, where those that survive do not move together. Chosen by eye."""
MIN_HOMOGRAPHY_SHARE = 0.6
"""Share of the survivors that one homography must explain, so that they count as moving together. Chosen by eye."""
HOMOGRAPHY_TOLERANCE = 2.0
"""Pixels by which they may miss it. Chosen by eye."""
MIN_TRACKS = 8
"""Tracks below which nothing can be said about the camera. Chosen by eye."""
PIECE_DISTANCE = 100.0
"""Median distances between the worlds of two pieces, set side by side: no camera sees into the next one. Chosen by eye."""


def find_breaks(seen: Observations, shown: Sequence[int]) -> list[int]:
    """Return the frames that share hardly a track with the last one before them that shows anything.

    Args:
        seen: the tracks, in pixels.
        shown: the frames that are not blank.
    """
    rows = seen.by_camera()

    def is_torn(a: int, b: int) -> bool:
        _, before, after = np.intersect1d(seen.point[rows[a]], seen.point[rows[b]], assume_unique=True, return_indices=True)
        return are_torn(seen.uv[rows[a][before]], seen.uv[rows[b][after]], len(rows[a]))

    return [b for a, b in pairwise(shown) if is_torn(a, b)]


def are_torn(a: np.ndarray, b: np.ndarray, count: int) -> bool:
    """Return whether two frames show different places, or cannot be told to show the same.

    Args:
        a: [M, 2] pixels of the points of the first that were found in the second; ``b`` where they are there.
        count: points of the first that were looked for.
    """
    share = len(a) / max(count, 1)
    if len(a) < MIN_TRACKS or share < MIN_SURVIVORS:
        return True
    if share >= FEW_SURVIVORS:
        return False
    # Noise and foreign images always offer some points that look alike, but those move every way.
    _, together = cv2.findHomography(a, b, cv2.RANSAC, HOMOGRAPHY_TOLERANCE)
    return together is None or together.mean() < MIN_HOMOGRAPHY_SHARE


def split(shown: Sequence[int], breaks: Sequence[int]) -> list[list[int]]:
    """Return the shown frames of every piece; none where most frames stand alone, because nothing in them can be followed."""
    pieces: list[list[int]] = [[]]
    for t in shown:
        if t in set(breaks):
            pieces.append([])
        pieces[-1].append(t)
    alone = sum(len(piece) == 1 for piece in pieces)
    return pieces if shown and alone <= max(1, len(shown) // 2) else []


def join(pieces: Sequence[Sequence[int]], cameras: Sequence[Sequence[Camera]], count: int) -> list[Camera]:
    """Return one camera for each of ``count`` frames: the pieces side by side, blank frames interpolated within their piece.

    Args:
        pieces: the frames of every piece.
        cameras: their cameras, the first one of every piece the identity.
    """
    result: list[Camera] = []
    ends = [piece[0] for piece in pieces[1:]] + [count]
    for number, (frames, found, end) in enumerate(zip(pieces, cameras, ends, strict=True)):
        path = CameraPath(frames, [_aside(camera, number * PIECE_DISTANCE) for camera in found])
        known = dict(zip(frames, path.cameras, strict=True))
        result += [known.get(t) or path.at(t) for t in range(len(result), end)]
    return result


def _aside(camera: Camera, distance: float) -> Camera:
    """Return the camera in a world that was moved to the right by ``distance``."""
    shift = np.eye(4)
    shift[0, 3] = -distance
    return Camera(camera.viewmat @ shift, camera.K, camera.width, camera.height)
