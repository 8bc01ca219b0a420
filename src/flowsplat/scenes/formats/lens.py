"""Lens distortion that comes with other people's cameras: what a pinhole may leave out."""

from __future__ import annotations

from pathlib import Path

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.lens import Distortion, compute_shift

MAX_DISTORTION = 1.0
"""Pixels by which a lens may move a point of the image's border and still count as a pinhole. Chosen by eye."""


def require_pinhole(where: Path | str, camera: Camera, distortion: Distortion) -> None:
    """Refuse a lens that is no pinhole.

    Args:
        where: what to call the file in an error.

    Raises:
        InputError: it moves points of the border by more than ``MAX_DISTORTION`` pixels.
    """
    if distortion.is_fisheye:
        raise InputError(f"{where} describes a fisheye: give pinholes, the cameras of undistorted images.")
    error = compute_shift(camera.K, distortion, camera.width, camera.height)
    if not error <= MAX_DISTORTION:  # so that NaN is refused, too
        raise InputError(
            f"{where} describes a lens that bends the image by {error:.1f} pixels: give pinholes, the cameras of undistorted ones."
        )
