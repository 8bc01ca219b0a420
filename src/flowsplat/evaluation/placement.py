"""Place a held-out view in a scene whose cameras were estimated (docs/method/evaluation.md)."""

from __future__ import annotations

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.geometry import Camera
from flowsplat.geometry.similarity import align_paths
from flowsplat.scenes import HeldoutView, Scene
from flowsplat.scenes.ingest import CALIBRATED


def cameras_are_true(scene: Scene) -> bool:
    """Return whether the scene's cameras share the coordinates of the truth and of the held-out views."""
    return (scene.prior("cameras") or {}).get("method") in ("truth", CALIBRATED)


def true_scale(scene: Scene) -> float:
    """Units of the truth per unit of the scene's cameras: 1 where these are true or where no true path is known."""
    if cameras_are_true(scene) or scene.truth is None or not scene.truth.has_cameras:
        return 1.0
    return align_paths(scene.cameras, scene.truth.cameras).scale


def view_camera(scene: Scene, view: HeldoutView) -> Camera:
    """Return the camera that renders a held-out view.

    With true cameras it is the view's own. With estimated ones it stands to the estimated camera of its time as the
    true one stands to the true camera: a global similarity would not do, because the rotation about a nearly straight
    path is undetermined. One scale per clip brings the offset into the scene's units, and the focal length is off by
    the same factor as the clip's.

    Raises:
        InputError: the cameras are estimated and the true ones, which tell where the view stands, are not known.
    """
    if cameras_are_true(scene):
        return view.camera
    if scene.truth is None or not scene.truth.has_cameras:
        raise InputError(
            f"{scene.folder} has held-out views but no true cameras of the clip to place them by. "
            "Prepare it again from a source that has both."
        )
    estimated = scene.cameras[view.frame]
    true = scene.truth.cameras[view.frame].resize(estimated.width, estimated.height)
    offset = view.camera.viewmat @ np.linalg.inv(true.viewmat)
    offset[:3, 3] /= true_scale(scene)
    K = view.camera.K.copy()
    K[[0, 1], [0, 1]] *= estimated.K[[0, 1], [0, 1]] / true.K[[0, 1], [0, 1]]
    pixels = np.array([view.camera.width / estimated.width, view.camera.height / estimated.height])
    K[:2, 2] += pixels * (estimated.K - true.K)[:2, 2]
    return Camera(offset @ estimated.viewmat, K, view.camera.width, view.camera.height)
