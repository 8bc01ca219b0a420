"""Where cameras other than pinholes show a point, and the Jacobian of it, in torch: orthographic and fisheye.

Names and conventions are gsplat's (``camera_model``). All of them cull by planar depth, so a fisheye sees what is in front of it.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from flowsplat.geometry.projection import camera_jacobian

CameraModel = Literal["pinhole", "ortho", "fisheye"]
CAMERA_MODELS: tuple[CameraModel, ...] = ("pinhole", "ortho", "fisheye")
"""What is covered."""
FISHEYE_COEFFICIENTS = 4
"""Of the polynomial in the angle (OpenCV's ``fisheye``)."""
MIN_AXIS_DISTANCE = 1e-6
"""Tangent of the angle to the axis below which a point counts as on it: there the angle has no direction, and a root no slope."""


def project_in_camera(
    points: Tensor, K: Tensor, width: int, height: int, camera_model: CameraModel, radial_coeffs: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Project points of positive depth.

    Args:
        points: [N, 3] in camera axes (OpenCV).
        K: [3, 3] pixels; of ``ortho``, pixels for one unit of length.
        width: pixels.
        height: pixels.
        camera_model: of the camera.
        radial_coeffs: [4] of a fisheye, see ``_project_fisheye``; None = zeros.

    Returns:
        pixels [N, 2]; their derivative with respect to the point [N, 2, 3], of a pinhole clamped as ``camera_jacobian`` says; and
        bool [N], whether the camera shows such a point.
    """
    if camera_model == "fisheye":
        return _project_fisheye(points, K, radial_coeffs)
    focals, center = K[[0, 1], [0, 1]], K[:2, 2]
    shows = torch.ones_like(points[:, 0], dtype=torch.bool)
    if camera_model == "ortho":
        zeros = torch.zeros_like(focals[0])
        J = torch.stack([torch.stack([focals[0], zeros, zeros]), torch.stack([zeros, focals[1], zeros])])
        return points[:, :2] * focals + center, J.expand(len(points), 2, 3), shows
    return points[:, :2] / points[:, 2:] * focals + center, camera_jacobian(points, K, width, height), shows


def _project_fisheye(points: Tensor, K: Tensor, radial_coeffs: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Show a point at an angle theta to the axis at the distance theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) from
    the middle, at focal length 1 (Kannala and Brandt 2006; https://docs.opencv.org/4.x/db/d58/group__calib3d__fisheye.html).

    From the angle on at which that first falls, the lens would show two points in one place: there it shows none.
    """
    x, y, z = points.unbind(1)
    radius = torch.sqrt(torch.clamp(x * x + y * y, min=(MIN_AXIS_DISTANCE * z.detach()) ** 2))
    toward_x, toward_y = x / radius, y / radius  # of length 1, and nearly 0 on the axis
    theta = torch.atan2(radius, z)
    squared = theta * theta
    distance, slope, shows = theta, torch.ones_like(theta), torch.ones_like(theta, dtype=torch.bool)
    if radial_coeffs is not None:
        stretch, derivative = torch.ones_like(theta), torch.ones_like(theta)
        power = torch.ones_like(theta)
        for k, coefficient in enumerate(radial_coeffs.unbind(0), 1):
            power = power * squared
            stretch, derivative = stretch + coefficient * power, derivative + (2 * k + 1) * coefficient * power
        distance, slope = theta * stretch, derivative
        shows = theta.detach() < _find_fold(radial_coeffs)
    focals, center = K[[0, 1], [0, 1]], K[:2, 2]
    pixels = torch.stack([distance * toward_x, distance * toward_y], 1) * focals + center
    # theta grows by z / (x^2 + y^2 + z^2) away from the axis and by -radius / (...) along it; across, the direction alone turns.
    inverse = slope / (radius * radius + z * z)
    outwards, across = z * inverse, distance / radius
    difference, along = outwards - across, -radius * inverse
    row_u = torch.stack([across + toward_x * toward_x * difference, toward_x * toward_y * difference, toward_x * along], 1)
    row_v = torch.stack([toward_x * toward_y * difference, across + toward_y * toward_y * difference, toward_y * along], 1)
    return pixels, torch.stack([row_u, row_v], 1) * focals[:, None], shows


def _find_fold(radial_coeffs: Tensor) -> float:
    """Return the smallest angle at which the distance from the middle stops to grow; infinity where it always grows."""
    slope = [1.0] + [(2 * k + 1) * value for k, value in enumerate(radial_coeffs.detach().double().tolist(), 1)]
    roots = np.roots(slope[::-1])  # in the square of the angle
    angles = roots.real[(np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots))) & (roots.real > 0)]
    return math.sqrt(angles.min()) if len(angles) else math.inf
