"""A handful of moving Gaussians and the noisy images of them: the smallest thing that can be trained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from flowsplat.gaussians.gaussians4d import Gaussians4D, parameter_shapes
from flowsplat.gaussians.motion import SharedMotion, motion_model
from flowsplat.gaussians.observations import Observation, Observations
from flowsplat.gaussians.render import render
from flowsplat.geometry import Camera, Similarity
from flowsplat.scenes import Flow
from flowsplat.training.config import PRESETS, TrainConfig

WIDTH, HEIGHT, FRAMES = 24, 16, 3


def a_few(config: TrainConfig, count: int = 24) -> Gaussians4D:
    """Gaussians before the cameras, two thirds of them moving."""
    g = torch.Generator().manual_seed(0)
    params = {name: 0.1 * torch.randn(count, *shape, generator=g) for name, shape in parameter_shapes(config.model).items()}
    params["means"] = params["means"] * torch.tensor([3.0, 2.0, 1.0]) + torch.tensor([0.0, 0.0, 1.0])
    params["log_radii" if "log_radii" in params else "log_scales"] -= 2.5
    params["times"] = torch.randint(FRAMES, (count,), generator=g) / (FRAMES - 1)
    params["log_lambdas"] += 2.0
    motion = motion_model(config.model)
    shared = motion.initial_shared() if isinstance(motion, SharedMotion) else {}
    return Gaussians4D(params, torch.arange(count) % 3 > 0, config.model, config.model.sh_degree, shared=shared)


def seen(gaussians: Gaussians4D) -> Observations:
    """Noisy images, depth and flow of them."""
    rng = np.random.default_rng(0)
    K = np.array([[20.0, 0, WIDTH / 2], [0, 20, HEIGHT / 2], [0, 0, 1]])
    cameras = []
    for k in range(FRAMES):
        viewmat = np.eye(4)
        viewmat[0, 3] = -0.02 * k
        cameras.append(Camera(viewmat, K, WIDTH, HEIGHT))
    frames = []
    for k, camera in enumerate(cameras):
        shown = render(gaussians, camera, k / (FRAMES - 1))
        flow = Flow(k, k + 1, rng.normal(0, 1, (HEIGHT, WIDTH, 2)).astype(np.float32), np.ones((HEIGHT, WIDTH), np.float32))
        frames.append(
            Observation(
                frame=k, time=k / (FRAMES - 1), camera=camera,
                image=(255 * np.clip(shown.color.numpy() + rng.normal(0, 0.1, (HEIGHT, WIDTH, 3)), 0, 1)).astype(np.uint8),
                depth=rng.uniform(0.8, 1.2, (HEIGHT, WIDTH)).astype(np.float32), depth_trusted=rng.random((HEIGHT, WIDTH)) < 0.8,
                object_ids=np.zeros((HEIGHT, WIDTH), np.uint8), forward=flow if k + 1 < FRAMES else None, backward=None,
            )
        )  # fmt: skip
    return Observations(frames, Similarity())


def tiny(preset: str, **changes) -> TrainConfig:
    config = PRESETS[preset]
    model = replace(config.model, mean_poly=2, mean_fourier=1, quat_poly=1, quat_fourier=1, sh_degree=1)
    return replace(
        config, iterations=2, preview_every=0, model=model, loss=replace(config.loss, rigid_neighbors=4),
        density=replace(config.density, every=0, reset_every=0), **changes,
    )  # fmt: skip
