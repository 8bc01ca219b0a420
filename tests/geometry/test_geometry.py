"""Cameras, rotations, similarities and paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flowsplat.geometry import Camera, Similarity
from flowsplat.geometry.cameras import pixel_grid, unproject_depth
from flowsplat.geometry.paths import CameraPath, crop_camera, dolly_zoom, orbit, shift_camera, smooth_path
from flowsplat.geometry.projection import project_points, world_jacobian
from flowsplat.geometry.rotations import (
    covariances,
    quats_to_rotations,
    rotations_to_quats,
)
from flowsplat.geometry.similarity import align_paths, path_errors


def random_camera(rng: np.random.Generator, width: int = 40, height: int = 30) -> Camera:
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix()
    viewmat[:3, 3] = rng.normal(0, 0.3, 3)
    return Camera(viewmat, np.array([[35.0, 0, 20.5], [0, 36, 14], [0, 0, 1]]), width, height)


def test_unprojecting_undoes_projecting():
    rng = np.random.default_rng(0)
    camera = random_camera(rng)
    uv, depth = rng.uniform(0, 30, (50, 2)), rng.uniform(0.5, 5, 50)
    back, z = camera.project(camera.unproject(uv, depth))
    np.testing.assert_allclose(back, uv, atol=1e-9)
    np.testing.assert_allclose(z, depth, atol=1e-12)


def test_a_transposed_viewmat_is_no_camera():
    camera = random_camera(np.random.default_rng(0))
    assert camera.is_valid
    assert not replace(camera, viewmat=camera.viewmat.T).is_valid
    for last in ([0, 0, 0, 0], [0, 0, 0, 2], [0, 0, 1e-3, 1]):
        assert not replace(camera, viewmat=np.vstack([camera.viewmat[:3], last])).is_valid


def test_torch_and_numpy_project_alike():
    rng = np.random.default_rng(1)
    camera = random_camera(rng)
    points = rng.normal(0, 0.5, (20, 3)) + [0, 0, 4]
    uv, z = project_points(torch.from_numpy(points), *camera.tensors(torch.float64))
    expected, depth = camera.project(points)
    np.testing.assert_allclose(uv.numpy(), expected, atol=1e-9)
    np.testing.assert_allclose(z.numpy(), depth, atol=1e-12)


def test_first_pixel_center_is_half():
    assert pixel_grid(3, 2)[0, 0].tolist() == [0.5, 0.5]
    camera = Camera(np.eye(4), np.array([[10.0, 0, 1.5], [0, 10, 1], [0, 0, 1]]), 3, 2)
    np.testing.assert_allclose(unproject_depth(np.ones((2, 3)), camera)[0, 0], [-0.1, -0.05, 1])


def test_jacobian_is_the_derivative():
    rng = np.random.default_rng(2)
    camera = random_camera(rng)
    viewmat, K = camera.tensors(torch.float64)
    points = torch.from_numpy(camera.unproject(rng.uniform(2, 28, (10, 2)), rng.uniform(1, 4, 10)))
    J = world_jacobian(points, viewmat, K, camera.width, camera.height)
    exact = torch.stack([torch.autograd.functional.jacobian(lambda x: project_points(x, viewmat, K)[0], p) for p in points])
    torch.testing.assert_close(J, exact)


@given(st.lists(st.floats(-2, 2), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
@settings(max_examples=50, deadline=None)
def test_quaternions_and_matrices_agree(q):
    quats = torch.tensor([q], dtype=torch.float64)
    R = quats_to_rotations(quats)
    np.testing.assert_allclose(R[0].numpy(), Rotation.from_quat(q, scalar_first=True).as_matrix(), atol=1e-9)
    torch.testing.assert_close(quats_to_rotations(rotations_to_quats(R)), R)


def test_a_zero_quaternion_has_finite_gradients():
    quats = torch.zeros(1, 4, dtype=torch.float64, requires_grad=True)
    covariances(quats, torch.ones(1, 3, dtype=torch.float64)).sum().backward()
    assert torch.isfinite(quats.grad).all()


def test_similarity_inverse_and_cameras():
    rng = np.random.default_rng(3)
    similarity = Similarity(2.5, Rotation.from_rotvec([0.2, 0.5, -0.1]).as_matrix(), np.array([1.0, -2, 0.5]))
    points = rng.normal(0, 1, (10, 3)) + [0, 0, 5]
    np.testing.assert_allclose(similarity.inverse().points(similarity.points(points)), points, atol=1e-12)
    camera = random_camera(rng)
    uv, z = camera.project(points)
    moved, scaled = similarity.camera(camera).project(similarity.points(points))
    np.testing.assert_allclose(moved, uv, atol=1e-8)
    np.testing.assert_allclose(scaled, 2.5 * z, atol=1e-9)
    assert Similarity.from_json(similarity.to_json()).scale == 2.5


def test_aligning_a_moved_path_gives_the_similarity_back():
    rng = np.random.default_rng(4)
    path = [random_camera(rng) for _ in range(6)]
    similarity = Similarity(0.3, Rotation.from_rotvec([0.1, -0.2, 0.4]).as_matrix(), np.array([3.0, 1, 2]))
    moved = [similarity.camera(camera) for camera in path]
    found = align_paths(path, moved)
    assert found.scale == pytest.approx(0.3)
    np.testing.assert_allclose(found.rotation, similarity.rotation, atol=1e-9)
    errors = path_errors(path, moved)
    assert errors["path"] < 1e-9
    assert errors["rotation"] < 1e-4
    assert errors["focal"] == 0


def test_camera_path_passes_through_its_cameras_and_holds_its_ends():
    rng = np.random.default_rng(5)
    cameras = [random_camera(rng) for _ in range(4)]
    path = CameraPath([0.0, 1, 2, 4], cameras)
    for time, camera in zip([0, 1, 2, 4, 9, -1], [*cameras, cameras[3], cameras[0]], strict=True):
        np.testing.assert_allclose(path.at(time).viewmat, camera.viewmat, atol=1e-9)
    assert path.at(0.5).is_valid


def test_orbit_is_closed_and_looks_at_its_target():
    camera = random_camera(np.random.default_rng(6))
    target = camera.center + 3 * camera.viewmat[2, :3]
    loop = orbit(camera, 3.0, 12)
    np.testing.assert_allclose(loop[0].viewmat, camera.viewmat, atol=1e-9)
    for view in loop:
        uv, z = view.project(target[None])
        np.testing.assert_allclose(uv[0], camera.K[:2, 2], atol=1e-6)
        assert z[0] == pytest.approx(3.0)


def test_smoothing_keeps_a_still_camera_and_calms_a_shaking_one():
    rng = np.random.default_rng(7)
    still = [random_camera(np.random.default_rng(8))] * 5
    np.testing.assert_allclose(smooth_path(still, 2.0)[2].viewmat, still[2].viewmat, atol=1e-9)
    shaking = [random_camera(rng) for _ in range(30)]
    before = np.diff([c.center for c in shaking], axis=0)
    after = np.diff([c.center for c in smooth_path(shaking, 3.0)], axis=0)
    assert np.abs(after).mean() < 0.3 * np.abs(before).mean()


def test_cameras_made_from_a_camera_see_what_they_promise():
    K = np.array([[50.0, 0, 34], [0, 55, 20], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_euler("xyz", [0.2, -0.4, 0.1]).as_matrix()
    viewmat[:3, 3] = 0.3, -0.2, 0.5
    camera = Camera(viewmat, K, 64, 48)
    uv = np.array([[5.0, 7.0], [32.0, 24.0], [60.0, 41.0]])
    plane = camera.unproject(uv, np.full(3, 3.0))

    aside = shift_camera(camera, 0.4, 3.0)
    np.testing.assert_allclose(aside.project(plane)[0], uv, atol=1e-9)
    np.testing.assert_allclose(aside.center - camera.center, 0.4 * camera.viewmat[0, :3], atol=1e-12)
    nearer = camera.unproject(uv, np.full(3, 2.0))
    np.testing.assert_allclose(aside.project(nearer)[0] - uv, np.tile([50 * 0.4 * (1 / 3 - 1 / 2), 0], (3, 1)), atol=1e-9)

    back = dolly_zoom(camera, 3.0, 1.5)
    np.testing.assert_allclose(back.project(plane)[0], uv, atol=1e-9)
    np.testing.assert_allclose(back.project(plane)[1], 4.5)

    corners = np.array([[8.0, 6.0], [56.0, 42.0]])  # of the middle three quarters
    seen = crop_camera(camera, 0.75).project(camera.unproject(corners, np.full(2, 2.0)))[0]
    np.testing.assert_allclose(seen, [[0, 0], [64, 48]], atol=1e-9)
