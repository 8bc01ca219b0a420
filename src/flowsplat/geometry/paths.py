"""Camera paths: interpolation between cameras, smoothing, orbits and bullet time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from flowsplat.geometry.cameras import Camera, rigid


def _camera_at(center: np.ndarray, rotation: np.ndarray, like: Camera) -> Camera:
    return Camera(rigid(rotation, -rotation @ center), like.K, like.width, like.height)


class CameraPath:
    """Cameras at times, and every camera between them: cubic in position, slerp in rotation, linear in K.

    Outside the given times the first or last camera is held.
    """

    def __init__(self, times: Sequence[float], cameras: Sequence[Camera]):
        self.cameras = list(cameras)
        self.times = np.asarray(times, np.float64)
        if len(self.times) > 1:
            self._centers = CubicSpline(self.times, [c.center for c in cameras])
            self._rotations = Slerp(self.times, Rotation.from_matrix([c.viewmat[:3, :3] for c in cameras]))
            self._Ks = np.array([c.K for c in cameras])

    def at(self, time: float) -> Camera:
        """Return the camera at ``time``; at a given time it is the given camera up to rounding."""
        first = self.cameras[0]
        if len(self.times) == 1:
            return first
        time = float(np.clip(time, self.times[0], self.times[-1]))
        K = np.stack([np.interp(time, self.times, self._Ks[:, r, c]) for r in range(3) for c in range(3)]).reshape(3, 3)
        camera = _camera_at(self._centers(time), self._rotations(time).as_matrix(), first)
        return Camera(camera.viewmat, K, first.width, first.height)


def smooth_path(cameras: Sequence[Camera], sigma: float) -> list[Camera]:
    """Return the path low-passed by a Gaussian of ``sigma`` frames in position and rotation."""
    centers = gaussian_filter1d(np.array([c.center for c in cameras]), sigma, axis=0, mode="nearest")
    quats = Rotation.from_matrix([c.viewmat[:3, :3] for c in cameras]).as_quat()
    for k in range(1, len(quats)):
        if quats[k] @ quats[k - 1] < 0:
            quats[k] *= -1
    rotations = Rotation.from_quat(gaussian_filter1d(quats, sigma, axis=0, mode="nearest")).as_matrix()
    return [_camera_at(x, R, c) for x, R, c in zip(centers, rotations, cameras, strict=True)]


def orbit(camera: Camera | Sequence[Camera], distance: float, steps: int, angle: float = 6.0) -> list[Camera]:
    """Return a closed loop around ``camera`` that keeps looking at the point ``distance`` in front of it.

    ``angle`` (degrees) is the half-width of the loop seen from that point; half as much up and down. Of ``steps`` cameras the loop
    goes round each for its step, so that it follows them.
    """
    cameras = [camera] * steps if isinstance(camera, Camera) else camera
    phases = np.linspace(0, 2 * np.pi, steps, endpoint=False)
    return [move_on_orbit(each, distance, phase, angle) for each, phase in zip(cameras, phases, strict=True)]


def move_on_orbit(camera: Camera, distance: float, phase: float, angle: float) -> Camera:
    """``camera`` moved to one place of that loop: ``phase`` goes from 0 to 2 pi."""
    return turn_aside(camera, distance, angle * np.sin(phase), angle / 2 * (1 - np.cos(phase)) / 2)


def turn_aside(camera: Camera, distance: float, yaw: float, pitch: float) -> Camera:
    """``camera`` turned round the point ``distance`` in front of it, by degrees: to its left and up where they are positive."""
    R, target = camera.viewmat[:3, :3], camera.center + camera.viewmat[2, :3] * distance
    turned = Rotation.from_euler("yx", [-yaw, pitch], degrees=True).as_matrix() @ R
    return _camera_at(target - turned[2] * distance, turned, camera)


def shift_camera(camera: Camera, offset: float, distance: float) -> Camera:
    """``camera`` moved to its right by ``offset``, looking the same way, so that what is at planar depth ``distance`` stays.

    The principal point moves instead of the camera turning: images of such cameras differ in x only, as eyes want it.
    """
    viewmat, K = camera.viewmat.copy(), camera.K.copy()
    viewmat[0, 3] -= offset
    K[0, 2] += K[0, 0] * offset / distance
    return Camera(viewmat, K, camera.width, camera.height)


def dolly_zoom(camera: Camera, distance: float, factor: float) -> Camera:
    """``camera`` moved along its axis until planar depth ``distance`` is ``factor`` times as far, zoomed to show it as large."""
    viewmat, K = camera.viewmat.copy(), camera.K.copy()
    viewmat[2, 3] += distance * (factor - 1)
    K[[0, 1], [0, 1]] *= factor
    return Camera(viewmat, K, camera.width, camera.height)


def crop_camera(camera: Camera, share: float) -> Camera:
    """Return what the middle of the image shows, ``share`` of its width and height, with as many pixels as the whole."""
    middle = np.array([camera.width, camera.height]) / 2
    K = camera.K.copy()
    K[:2, 2] -= middle
    K[:2] /= share
    K[:2, 2] += middle
    return Camera(camera.viewmat, K, camera.width, camera.height)
