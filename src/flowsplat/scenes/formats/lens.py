"""Lens distortion that comes with other people's cameras: ours are pinholes, so it must be small enough to leave out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from flowsplat.common.errors import InputError

MAX_DISTORTION = 1.0
"""Pixels by which a lens may move a point of the image's border and still count as a pinhole. Chosen by eye."""


def require_pinhole(where: Path | str, K: np.ndarray, width: int, height: int, distortion: Sequence[float], cure: str = "") -> None:
    """Refuse a lens that is no pinhole.

    Args:
        where: what to call the file in an error.
        K: [3, 3] in pixels of an image of ``width`` x ``height``.
        distortion: k1, k2, p1, p2, k3, ... as OpenCV orders them.
        cure: what undistorts such images, in brackets for the error.

    Raises:
        InputError: it moves points of the border by more than ``MAX_DISTORTION`` pixels.
    """
    if not any(distortion):
        return
    side = np.linspace(0, 1, 9)
    edge = np.concatenate([np.stack([side, 0 * side + end], 1) for end in (0, 1)])
    border = np.concatenate([edge, edge[:, ::-1]]) * [width, height]
    rays = np.concatenate([(border - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((len(border), 1))], 1)
    moved, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.asarray(distortion, np.float64))
    error = float(np.linalg.norm(moved[:, 0] - border, axis=1).max())
    if not error <= MAX_DISTORTION:  # so that NaN is refused, too
        raise InputError(
            f"{where} describes a lens that bends the image by {error:.1f} pixels: undistort the images first{cure}, "
            "and give the cameras of the undistorted ones."
        )
