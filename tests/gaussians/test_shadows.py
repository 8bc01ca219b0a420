"""The background without the shadows of what moves."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.gaussians import shadows
from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.gaussians.shadows import add_shadow_free
from flowsplat.geometry import Camera, Similarity
from flowsplat.splatting.harmonics import harmonics_from_colors
from flowsplat.training.checkpoint import load_model, save_model

WIDTH, HEIGHT, FRAMES = 96, 48, 25
SHADE, REACH = 0.4, 9
"""Logarithm of a shadow's brightness, and pixels round the middle of the object up to which it lies."""
TIMES = np.linspace(0, 1, FRAMES).tolist()
CAMERA = Camera(np.eye(4), np.array([[96.0, 0, WIDTH / 2], [0, 96.0, HEIGHT / 2], [0, 0, 1]]), WIDTH, HEIGHT)


def wall(middles: np.ndarray) -> tuple[SceneModel, list[np.ndarray]]:
    """A gray wall, darker where columns are near those of ``middles`` [T], and masks of an object there that is not drawn."""
    config = ModelConfig(mean_poly=1, mean_fourier=0, quat_poly=0, quat_fourier=0, sh_degree=0, gains=16, freeze_background=True)
    u, v = np.meshgrid(np.arange(-1.0, WIDTH + 1, 1.5), np.arange(-1.0, HEIGHT + 1, 1.5))
    count = u.size
    params = {name: torch.zeros(count, *shape) for name, shape in parameter_shapes(config).items()}
    points = np.stack([(u - WIDTH / 2) / 96, (v - HEIGHT / 2) / 96, np.ones_like(u)], -1).reshape(-1, 3)
    params["means"] = torch.from_numpy(points.astype(np.float32))
    params["quats"][:, 0] = 1
    params["log_scales"][:] = math.log(1.2 / 96)
    params["logit_opacities"][:] = 3
    params["log_lambdas"][:] = -13
    params["times"][:] = 0.5
    shade = -SHADE * (np.abs(u.reshape(-1, 1) - middles) < REACH)
    waves = np.cos(np.pi * np.outer(TIMES, np.arange(17)))
    fitted = np.linalg.solve(waves.T @ waves + 0.01 * np.eye(17), waves.T @ shade.T).T
    params["log_gains"] = torch.from_numpy(fitted[:, 1:].astype(np.float32))
    params["sh"][:, 0] = harmonics_from_colors(0.5 * torch.from_numpy(np.exp(fitted[:, :1]).astype(np.float32)).expand(-1, 3))
    masks = [np.zeros((HEIGHT, WIDTH), np.uint8) for _ in TIMES]
    for mask, middle in zip(masks, middles, strict=True):
        mask[16:32, max(int(middle) - 6, 0) : int(middle) + 6] = 1
    gaussians = Gaussians4D(params, torch.zeros(count, dtype=torch.bool), config)
    return SceneModel(gaussians, Similarity(1.0, np.eye(3), np.zeros(3)), 0.0, 1.0), masks


def test_a_curve_is_fitted_as_by_sums_over_products():
    rng = np.random.default_rng(0)
    times, gains = 30, 7
    cosines = torch.cos(math.pi * torch.linspace(0, 1, times, dtype=torch.float64)[:, None] * torch.arange(1, gains + 1))
    target, weight = rng.normal(0, 0.1, (50, times)), np.where(rng.random((50, times)) < 0.6, 1.0, shadows.UNSEEN_WEIGHT)
    A = np.concatenate([np.ones((times, 1)), cosines.numpy()], 1)
    held = shadows.GAIN_STIFFNESS * times * np.diag([0, *range(1, gains + 1)])
    expected = [np.linalg.solve(A.T * w @ A + held, A.T @ (w * b)) for b, w in zip(target, weight, strict=True)]
    np.testing.assert_allclose(shadows._fit(target, weight, cosines), expected, atol=1e-7)


def test_a_shadow_that_goes_by_is_gone_from_the_background_alone():
    middles = np.linspace(10, 86, FRAMES)
    model, masks = wall(middles)
    shadow_free = add_shadow_free(model, [CAMERA] * FRAMES, TIMES, masks)
    for k in (6, 12, 18):
        shaded = slice(int(middles[k]) - 5, int(middles[k]) + 5)
        before = model.render(CAMERA, TIMES[k]).color[:, shaded]
        after = shadow_free.part("background").render(CAMERA, TIMES[k]).color[:, shaded]
        elsewhere = model.render(CAMERA, TIMES[(k + 12) % FRAMES]).color[:, shaded]
        assert before.mean() < 0.8 * elsewhere.mean()
        assert after.mean() == pytest.approx(elsewhere.mean(), rel=0.05)
        np.testing.assert_array_equal(shadow_free.render(CAMERA, TIMES[k]).color, model.render(CAMERA, TIMES[k]).color)


def test_a_shadow_that_stays_cannot_be_told():
    model, masks = wall(np.full(FRAMES, 48.0))
    shadow_free = add_shadow_free(model, [CAMERA] * FRAMES, TIMES, masks)
    before, after = (each.part("background").render(CAMERA, 0.5).color for each in (model, shadow_free))
    np.testing.assert_allclose(before, after, atol=1e-6)


def test_how_bright_it_is_without_is_kept_in_the_file(tmp_path):
    model, masks = wall(np.linspace(10, 86, FRAMES))
    shadow_free = add_shadow_free(model, [CAMERA] * FRAMES, TIMES, masks)
    save_model(tmp_path, shadow_free)
    assert torch.equal(load_model(tmp_path).gaussians.shadow_free, shadow_free.gaussians.shadow_free)
    assert torch.equal(shadow_free.gaussians.select(torch.tensor([3, 1])).shadow_free, shadow_free.gaussians.shadow_free[[3, 1]])
    shadow_free.gaussians.shadow_free[0, 0] = float("nan")
    save_model(tmp_path, shadow_free)
    with pytest.raises(InputError, match="how bright a Gaussian is without shadows"):
        load_model(tmp_path)
