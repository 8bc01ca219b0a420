import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowsplat.evaluation.placement import true_scale, view_camera
from flowsplat.geometry import Camera, Similarity

MOVED = Similarity(0.4, Rotation.from_euler("xyz", [0.3, -0.2, 0.5]).as_matrix(), np.array([1.0, 2, -3]))


def test_true_cameras_are_used_as_they_are(build_scene):
    scene = build_scene()
    assert true_scale(scene) == 1
    for view in scene.views:
        assert view_camera(scene, view) is view.camera


def test_an_estimate_off_by_a_similarity_sees_the_same(build_scene):
    scene = build_scene(similarity=MOVED)
    assert true_scale(scene) == pytest.approx(1 / 0.4)
    for view in scene.views:
        np.testing.assert_allclose(view_camera(scene, view).viewmat, MOVED.camera(view.camera).viewmat, atol=1e-9)
        np.testing.assert_allclose(view_camera(scene, view).K, view.camera.K)


def test_a_wrong_focal_length_is_wrong_in_the_view_too(build_scene):
    scene = build_scene(similarity=MOVED)
    scale, shift = np.diag([1.1, 1.2, 1.0]), np.array([[0, 0, 3.0], [0, 0, -2.0], [0, 0, 0]])
    scene.write_cameras([Camera(c.viewmat, c.K @ scale + shift, c.width, c.height) for c in scene.cameras])
    view = scene.views[0]
    np.testing.assert_allclose(view_camera(scene, view).K, view.camera.K @ scale + shift)


def test_an_error_of_one_camera_moves_its_view_along(build_scene):
    """The view hangs on the camera of its own time, not on the whole path."""
    scene = build_scene(similarity=MOVED)
    view = next(view for view in scene.views if view.frame == 4)
    before = view_camera(scene, view)
    slip = np.eye(4)
    slip[:3, :3] = Rotation.from_euler("y", 1.0, degrees=True).as_matrix()
    cameras = [Camera(slip @ c.viewmat, c.K, c.width, c.height) if i == 4 else c for i, c in enumerate(scene.cameras)]
    scene.write_cameras(cameras)
    after = view_camera(scene, view)
    turned = after.viewmat[:3, :3] @ before.viewmat[:3, :3].T
    assert np.degrees(Rotation.from_matrix(turned).magnitude()) == pytest.approx(1, abs=1e-6)
