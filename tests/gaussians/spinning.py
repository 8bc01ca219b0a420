"""A plate that swings and spins in front of a wall, made of Gaussians that live shortly and move exactly as it does."""

from __future__ import annotations

import math

import numpy as np
import torch

from flowsplat.gaussians.gaussians4d import Gaussians4D, concatenate, parameter_shapes
from flowsplat.gaussians.model import SceneModel
from flowsplat.gaussians.model_config import ModelConfig
from flowsplat.geometry import Camera, Similarity

W, SWING = 2.0, 0.3
"""Radians per clip: the plate swings with W and turns by 2 W; it swings by SWING."""
WALL, PLATE, SCREEN = 4.0, 2.5, 1.5
"""Depths."""
FRAMES, LAST = 13, 1.5
"""Frames of the clip, and its last second."""
CONFIG = ModelConfig(
    mean_poly=0, mean_fourier=2, quat_poly=0, quat_fourier=1, fourier_base=W, sh_degree=0, freeze_background=True
)  # fmt: skip
SIMILARITY = Similarity(1 / WALL, np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([0.3, -0.2, 0.1]))


def on_plate(offset: np.ndarray, t: float) -> np.ndarray:
    """Where the point [..., 2] of the plate is at clip time ``t``: [..., 3]."""
    c, s = math.cos(2 * W * t), math.sin(2 * W * t)
    x, y = offset[..., 0], offset[..., 1]
    return np.stack([SWING * math.sin(W * t) + c * x - s * y, s * x + c * y, np.full_like(x, PLATE)], -1)


def off_plate(point: np.ndarray, t: float) -> np.ndarray:
    """The inverse of ``on_plate``: [..., 2]."""
    c, s = math.cos(2 * W * t), math.sin(2 * W * t)
    x, y = point[..., 0] - SWING * math.sin(W * t), point[..., 1]
    return np.stack([c * x + s * y, -s * x + c * y], -1)


def camera_at(i: int, size: tuple[int, int] = (96, 72)) -> Camera:
    """To the right by 0.2 in all."""
    width, height = size
    viewmat = np.eye(4)
    viewmat[0, 3] = -0.2 * i / (FRAMES - 1)
    return Camera(viewmat, np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]]), width, height)


def timestamps() -> np.ndarray:
    return np.linspace(0, LAST, FRAMES)


def cameras() -> list[Camera]:
    return [camera_at(i) for i in range(FRAMES)]


def _grid(half: float, step: float) -> np.ndarray:
    side = np.arange(-half, half + 1e-6, step)
    return np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)


def _resting(points: np.ndarray, size: float) -> Gaussians4D:
    params = {name: torch.zeros(len(points), *shape) for name, shape in parameter_shapes(CONFIG).items()}
    params["means"] = torch.tensor(SIMILARITY.points(points), dtype=torch.float32)
    params["quats"][:, 0] = 1.0
    params["log_scales"][:] = math.log(size * SIMILARITY.scale)
    params["logit_opacities"][:] = 4.0
    params["log_lambdas"][:] = -8.0
    return Gaussians4D(params, torch.zeros(len(points), dtype=torch.bool), CONFIG)


def _alive_around(mu: float, life: float) -> Gaussians4D:
    """The plate as it is seen around the clip time ``mu``, exact for all times."""
    offset = _grid(0.4, 0.08)
    part = _resting(on_plate(offset, mu), 0.06)
    params = part.params
    x, y = offset.T
    c, s = math.cos(2 * W * mu), math.sin(2 * W * mu)
    turned = np.stack([c * x - s * y, s * x + c * y, 0 * x], -1)
    quarter = np.stack([-s * x - c * y, c * x - s * y, 0 * x], -1)

    def linear(vectors: np.ndarray) -> torch.Tensor:
        return torch.tensor(SIMILARITY.scale * vectors @ SIMILARITY.rotation.T, dtype=torch.float32)

    params["mean_cos"][:, 0] = linear(np.array([SWING * math.sin(W * mu), 0, 0]))
    params["mean_sin"][:, 0] = linear(np.array([SWING * math.cos(W * mu), 0, 0]))
    params["mean_cos"][:, 1], params["mean_sin"][:, 1] = linear(turned), linear(quarter)
    # The turn is about the world's z, which the similarity brings elsewhere.
    axis = torch.tensor(SIMILARITY.rotation @ [0, 0, 1], dtype=torch.float32)
    params["quats"][:] = torch.cat([torch.tensor([math.cos(W * mu)]), math.sin(W * mu) * axis])
    params["quat_cos"][:, 0] = params["quats"]
    params["quat_sin"][:, 0] = torch.cat([torch.tensor([-math.sin(W * mu)]), math.cos(W * mu) * axis])
    params["times"][:] = mu
    params["log_lambdas"][:] = -2 * math.log(life)
    return Gaussians4D(params, torch.ones(len(offset), dtype=torch.bool), CONFIG)


def model(centers: int = 7, life: float = 0.08, screen: bool = False, until: float = 1.0) -> SceneModel:
    """The scene: ``centers`` sets of Gaussians on the plate with a temporal deviation of ``life``, none after ``until``.

    ``screen``: something at rest in front, left of the middle.
    """
    wall = np.concatenate([_grid(3.2, 0.16), np.full((len(_grid(3.2, 0.16)), 1), WALL)], 1)
    parts = [_resting(wall, 0.12)]
    if screen:
        x, y = _grid(0.3, 0.08).T
        parts.append(_resting(np.stack([x - 0.22, 3 * y, np.full_like(x, SCREEN)], -1), 0.06))
    parts += [_alive_around(mu, life) for mu in np.linspace(0, 1, centers) if mu <= until]
    return SceneModel(concatenate(parts), SIMILARITY, 0.0, LAST)
