"""Poses of held-out images: a wrong one is found, a right one is left alone, and the model stays as it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from flowsplat.evaluation import poses
from flowsplat.evaluation.metrics import psnr
from flowsplat.evaluation.poses import refine_camera
from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.geometry import Camera, Similarity

WIDTH, HEIGHT, FOCAL = 120, 90, 100.0
SIMILARITY = Similarity(0.5, np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([0.3, -0.2, 0.1]))
CONFIG = ModelConfig(mean_poly=1, mean_fourier=0, quat_poly=0, quat_fourier=0, sh_degree=1, freeze_background=True)


def textured(size: int = 70) -> SceneModel:
    """Two textured walls of Gaussians at depths 2 and 1.2 of the first camera, in the coordinates of ``SIMILARITY``."""
    rng = np.random.default_rng(0)
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1.6, 1.6, size)] * 2))
    near = (x > 0.2) & (np.abs(y) < 0.5)
    # Rough walls: where all depths are equal, the smallest turn of the camera changes which Gaussian is in front.
    z = np.where(near, 1.2, 2.0) + rng.uniform(-0.1, 0.1, len(x))
    colors = 0.5 + 0.2 * np.sin(5 * x[:, None] * [1, 1.3, 0.8] + 6 * y[:, None] * [1, -0.7, 1.2] + 2 * near[:, None])
    colors += 0.08 * rng.normal(size=colors.shape)
    params = {name: torch.zeros(len(x), *shape) for name, shape in parameter_shapes(CONFIG).items()}
    params["means"] = torch.from_numpy(np.stack([x * z / 2, y * z / 2, z], 1).astype(np.float32))
    params["quats"][:, 0] = 1
    params["log_scales"][:] = torch.log(torch.tensor([0.022, 0.022, 0.004]))
    params["logit_opacities"][:] = 3.0
    params["sh"][:, 0] = torch.from_numpy(((colors - 0.5) / 0.2820948).astype(np.float32))
    params["sh"][:, 1:] = 0.02 * torch.from_numpy(rng.normal(size=(len(x), 3, 3)).astype(np.float32))
    gaussians = Gaussians4D(params, torch.zeros(len(x), dtype=torch.bool), CONFIG, sh_degree=1)
    return SceneModel(gaussians, SIMILARITY, 0.0, 1.0)


def camera(shift=(0.0, 0.0, 0.0), angles=(0.0, 0.0, 0.0)) -> Camera:
    """A camera of the scene, which stands beside the first one of the model by a shift and small angles."""
    viewmat = poses._motion(np.array([*angles, *shift])) @ np.eye(4)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return SIMILARITY.inverse().camera(Camera(viewmat, K, WIDTH, HEIGHT))


@pytest.fixture(scope="module")
def model() -> SceneModel:
    return textured()


@pytest.mark.parametrize(
    "wrong",
    [
        {"shift": (0.02, 0.0, 0.0)},  # a pixel at depth 2
        {"angles": (0.0, 0.01, 0.0)},  # a pixel everywhere
        {"shift": (0.0, 0.03, -0.02), "angles": (0.01, 0.0, 0.01)},
        {"angles": (0.03, -0.04, 0.02)},  # five pixels: farther than the texture reaches
    ],
)
def test_a_wrong_pose_is_found(model, wrong):
    target = model.render(camera(), 0.5).color
    before = psnr(model.render(camera(**wrong), 0.5).color, target)
    refined = refine_camera(model, camera(**wrong), 0.5, target)
    after = psnr(model.render(refined, 0.5).color, target)
    assert after > before + 3
    assert after > 45
    assert refined.is_valid
    assert np.abs(refined.center - camera().center).max() < 0.01
    assert (refined.width, refined.height) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(refined.K, camera().K)


def test_a_right_pose_is_not_made_worse(model):
    """The image has what the model lacks: noise, and a thing that is not there."""
    target = model.render(camera(), 0.5).color + 0.03 * np.random.default_rng(1).normal(size=(HEIGHT, WIDTH, 3)).astype(np.float32)
    target[30:50, 40:60] = [1, 0, 0]
    before = psnr(model.render(camera(), 0.5).color, target)
    refined = refine_camera(model, camera(), 0.5, target)
    assert psnr(model.render(refined, 0.5).color, target) >= before - 0.05
    assert np.abs(refined.center - camera().center).max() < 0.05


def test_where_nothing_can_be_gained_the_camera_itself_comes_back(model):
    start = camera()
    assert refine_camera(model, start, 0.5, model.render(start, 0.5).color) is start
    away = camera(angles=(0.0, np.pi, 0.0))  # sees nothing
    assert refine_camera(model, away, 0.5, np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)) is away


def test_the_model_stays_as_it_is(model):
    before = {name: value.clone() for name, value in model.gaussians.params.items()}
    refine_camera(model, camera(shift=(0.02, 0, 0)), 0.5, model.render(camera(), 0.5).color)
    for name, value in model.gaussians.params.items():
        assert torch.equal(value, before[name])
        assert not value.requires_grad
        assert value.grad is None


def test_gradient_and_curvature_belong_to_the_error(model):
    """Against finite differences along every twist; the curvature to its order of magnitude, as it leaves terms out."""
    target = model.render(camera(shift=(0.01, 0.005, 0.0)), 0.5).color
    inner = SIMILARITY.camera(camera())
    look = poses._look(model.gaussians, inner, 0.5, target)
    for k in range(6):
        step = 1e-3
        ends = []
        for sign in (-1, 1):
            moved = Camera(poses._motion(sign * step * np.eye(6)[k]) @ inner.viewmat, inner.K, WIDTH, HEIGHT)
            ends.append(poses._look(model.gaussians, moved, 0.5, target).error)
        slope, bend = (ends[1] - ends[0]) / (2 * step), (ends[1] + ends[0] - 2 * look.error) / step**2
        assert slope == pytest.approx(look.gradient[k], rel=0.05, abs=2e-5)
        assert 0.4 < look.curvature[k, k] / bend < 2.5
    assert np.linalg.eigvalsh(look.curvature).min() >= -1e-9


def test_the_motion_of_a_twist_is_rigid():
    motion = poses._motion(np.array([0.3, -0.2, 0.5, 1, 2, 3]))
    np.testing.assert_allclose(motion[:3, :3] @ motion[:3, :3].T, np.eye(3), atol=1e-12)
    angle = np.arccos((np.trace(motion[:3, :3]) - 1) / 2)
    assert angle == pytest.approx(np.linalg.norm([0.3, -0.2, 0.5]))
    assert motion[:3, 3].tolist() == [1, 2, 3]
